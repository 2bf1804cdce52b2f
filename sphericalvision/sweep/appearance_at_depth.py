# SPDX-License-Identifier: Apache-2.0
"""What the cameras of a rig see at given depths: colours, and how far they agree."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.geometry.lookup import weighted_rows
from sphericalvision.icosphere import TriangleLocator, icosphere_vertices, level_from_num_vertices
from sphericalvision.kernels import Operator
from sphericalvision.shapes import check_shapes
from sphericalvision.sweep.visibility import check_seen

__all__ = ["AppearanceAtDepth", "appearance_at_depth"]


class AppearanceAtDepth(NamedTuple):
    """Colours of the cameras that see a point, in the unit of the images.

    Attributes:
        color: ``(B, K, C, V)`` their mean.
        deviation: ``(B, K, V)`` their mean absolute deviation from it, over cameras and colours.
        cameras: ``(B, K, V)`` how many there are; where none sees the point the others are 0.
    """

    color: Float[Tensor, "B K C V"]
    deviation: Float[Tensor, "B K V"]
    cameras: Float[Tensor, "B K V"]


@check_shapes
@torch.no_grad()
def appearance_at_depth(
    images: Float[Tensor, "B n C V_image"],
    seen: Bool[Tensor, "B n V_image"] | Bool[Tensor, "n V_image"],
    offsets: Float[Tensor, "B n 3"],
    inverse_depths: Float[Tensor, "B K V"],
) -> AppearanceAtDepth:
    """Return what cameras see at the points of K inverse depths at each vertex of an icosphere; without gradient.

    Args:
        images: ``(B, n, C, V_image)`` on icospheres aligned with the world.
        seen: ``(B, n, V_image)`` or ``(n, V_image)`` bool, True where the images show something.
        offsets: ``(B, n, 3)`` from each camera to the rig's centre, metres in the world.
        inverse_depths: ``(B, K, V)`` in 1/m; 0 is infinity.

    Examples:
        >>> images, seen = torch.ones(1, 2, 3, 162), torch.ones(2, 162, dtype=torch.bool)
        >>> offsets = torch.tensor([[[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]]])
        >>> color, deviation, cameras = appearance_at_depth(images, seen, offsets, torch.ones(1, 4, 642))
        >>> color.shape, deviation.max().item() < 1e-6, cameras.unique().tolist()
        (torch.Size([1, 4, 3, 642]), True, [2.0])
    """
    vertices = icosphere_vertices(
        level_from_num_vertices(inverse_depths.shape[-1]), offsets.dtype, images.device
    ).T.contiguous()
    locator = TriangleLocator(level_from_num_vertices(images.shape[-1]), offsets.dtype, images.device)
    weight = check_seen(seen, images).to(images)[:, :, None]
    rows = torch.cat((images * weight, weight), 2).transpose(2, 3).contiguous()  # colours next to each other
    return AppearanceAtDepth(*_appearance(rows, locator, vertices, offsets, inverse_depths))


def _by_sample(
    rows: Tensor, locator: TriangleLocator, vertices: Tensor, offsets: Tensor, inverse_depths: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Sample by sample and some vertices at once, so few that they stay in the cache of a CPU."""
    if not len(rows):
        return NotImplemented
    size = max(1, locator.chunk_size // inverse_depths.shape[1])
    samples = []
    for sample, offset, inverse_depth in zip(rows, offsets, inverse_depths, strict=True):
        chunks = [
            _seen_by_all(sample, locator, *chunk, offset)
            for chunk in zip(vertices.split(size, 1), inverse_depth.split(size, 1), strict=True)
        ]
        samples.append([torch.cat(values, -1) for values in zip(*chunks, strict=True)])
    color, deviation, cameras = (torch.stack(values) for values in zip(*samples, strict=True))
    return color, deviation, cameras


def _seen_by_all(
    rows: Tensor, locator: TriangleLocator, vertices: Tensor, inverse_depth: Tensor, offsets: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Color ``(K, C, V)``, deviation and cameras ``(K, V)`` of some vertices, so few that they stay in the cache."""
    weights, colors = [], []
    for row, offset in zip(rows, offsets, strict=True):
        triangles, shares = locator.find(
            (vertices[:, None] + offset[:, None, None] * inverse_depth).flatten(1)
        )
        bags = locator.faces.index_select(0, triangles)
        values = F.embedding_bag(bags, row, per_sample_weights=shares.T.to(row), mode="sum")
        color, shown = values.T.contiguous().view(-1, *inverse_depth.shape).split((row.shape[1] - 1, 1))
        weights.append((shown > 0.5).to(shown))
        colors.append(color / shown.clamp(min=0.5))
    cameras = torch.stack(weights).sum(0)
    mean, far = torch.zeros_like(colors[0]), torch.zeros_like(colors[0])
    for weight, color in zip(weights, colors, strict=True):
        mean += weight * color / cameras.clamp(min=1)
    for weight, color in zip(weights, colors, strict=True):
        far += weight * (color - mean).abs() / cameras.clamp(min=1)
    return mean.transpose(0, 1), far.mean(0), cameras[0]


def _all_at_once(
    rows: Tensor, locator: TriangleLocator, vertices: Tensor, offsets: Tensor, inverse_depths: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Colours ``(B, K, C, V)``, deviation and cameras ``(B, K, V)`` of images ``(B, n, V_image, C)`` without a loop."""
    batch, cameras, number, channels = rows.shape
    offset = offsets.permute(2, 0, 1)[..., None, None]
    rays = vertices[:, None, None, None] + offset * inverse_depths[:, None]  # (3, B, n, K, V)
    triangles, shares = locator.find(rays.flatten(1))
    first_row = torch.arange(0, batch * cameras * number, number, device=rows.device)
    bags = locator.faces.index_select(0, triangles).view(batch * cameras, inverse_depths.shape[1:].numel(), 3)
    bags = bags + first_row[:, None, None]
    values = weighted_rows(rows.reshape(-1, channels), bags.view(-1, 3), shares.T)
    values = values.view(*rays.shape[1:], channels)
    weights = (values[..., -1:] > 0.5).to(values)
    colors = values[..., :-1] / values[..., -1:].clamp(min=0.5)
    count = weights.sum(1)
    mean = (weights * colors).sum(1) / count.clamp(min=1)
    far = (weights * (colors - mean[:, None]).abs()).sum(1) / count.clamp(min=1)
    return mean.mT, far.mean(-1), count.squeeze(-1)


_appearance = Operator(_all_at_once, cpu=_by_sample, fused=_all_at_once)
