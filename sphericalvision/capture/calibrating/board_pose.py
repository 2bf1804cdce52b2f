# SPDX-License-Identifier: Apache-2.0
"""Where a known object stands, from the directions in which its points are seen: linear, and so past 90° as well."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.core import ArgumentError


def pose_from_directions(
    points: Float[Tensor, "m 3"], directions: Float[Tensor, "m 3"]
) -> Float[Tensor, "4 4"]:
    """The rigid transform (4, 4) that takes ``points`` (m, 3) to places along ``directions`` (m, 3), by algebra.

    d × (R X + t) = 0 is linear in R and t: two columns of R for points with z = 0 (a board), all three for others. The
    rotation nearest to the solution is taken. Good to start from, not to end with: ``refine``.

    Raises:
        ArgumentError: there are fewer than four points of a board, or six of another object.

    References:
        R. Hartley, A. Zisserman, "Multiple View Geometry", 2nd ed. (2004), section 7.1.

    Examples:
        >>> board = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [2, 1, 0]]).double()
        >>> seen = board + torch.tensor([0.0, 0.0, 3.0])
        >>> pose_from_directions(board, seen / seen.norm(dim=-1, keepdim=True))[:3, 3].round(decimals=6) + 0.0
        tensor([0., 0., 3.], dtype=torch.float64)
    """
    flat = bool((points[:, 2] == 0).all())
    needed = 4 if flat else 6
    if len(points) < needed:
        raise ArgumentError(f"points: expected at least {needed} points to find a pose, got {len(points)}")
    x = points.double()
    columns = torch.cat((x[:, :2] if flat else x, torch.ones_like(x[:, :1])), dim=-1)
    d = directions.double()
    cross = torch.linalg.cross(d.unsqueeze(-2).expand(-1, 3, -1), torch.eye(3).to(d).expand(len(d), 3, 3)).mT
    system = (cross.unsqueeze(-2) * columns[:, None, :, None]).flatten(-2).flatten(0, 1)
    solution = torch.linalg.svd(system).Vh[-1].reshape(-1, 3).mT
    if float(((columns @ solution.mT) * d).sum()) < 0:
        solution = -solution
    if flat:
        first, second, shift = solution.unbind(-1)
        scale = 2 / (first.norm() + second.norm())
        rotation = torch.stack((first, second, torch.linalg.cross(first, second) * scale), -1) * scale
    else:
        rotation, shift = solution[:, :3], solution[:, 3]
        sign = torch.linalg.det(rotation).sign()  # a mirrored solution puts the object behind
        scale = sign * torch.linalg.det(rotation).abs().clamp_min(1e-300) ** (-1 / 3)
        rotation = rotation * scale
    u, _, vh = torch.linalg.svd(rotation)
    pose = torch.eye(4, dtype=torch.float64, device=d.device)
    pose[:3, :3] = u @ torch.diag(torch.stack((*u.new_ones(2), torch.linalg.det(u @ vh)))) @ vh
    pose[:3, 3] = shift * scale
    return pose
