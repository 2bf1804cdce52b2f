# SPDX-License-Identifier: Apache-2.0
"""How many cameras of a rig see each direction at each depth, and how much they overlap."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int, Num
from torch import Tensor

from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import ArgumentError, check_type
from sphericalvision.geometry.directions import holds
from sphericalvision.shapes import check_shapes


class Overlap(NamedTuple):
    """Shares of the sphere's solid angle, from 0 to 1, at each depth (*)."""

    seen: Float[Tensor, "*depths"]
    """Seen by one camera or more."""
    shared: Float[Tensor, "*depths"]
    """Seen by two or more, so that depth can be told there."""
    mean: Float[Tensor, "*depths"]
    """Mean number of cameras that see a direction."""


@check_shapes
def coverage(
    rig: CameraRig, directions: Float[Tensor, "V 3"], depths: Sequence[float] | Num[Tensor, " ..."]
) -> Int[Tensor, "*rigs d V"]:
    """Number of cameras (*b, d, V) that see the points at ``depths`` (d,) along ``directions`` (V, 3).

    Fields of view, image borders and masks are considered, occlusion is not.

    Args:
        rig: single, or a batch of rigs.
        directions: unit directions (V, 3) from the rig's centre in the world, of any grid.
        depths: metres; infinity is allowed.

    Raises:
        ArgumentError: a depth is not positive.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(4)  # fisheyes of 220° that look forward, right, back and left
        >>> forward, between = [0.0, 0.0, 1.0], [0.6, 0.0, 0.8]
        >>> coverage(rig, torch.tensor([forward, between]), depths=[1.0, float("inf")]).tolist()
        [[3, 2], [3, 2]]
    """
    check_type("rig", rig, CameraRig)
    far = torch.as_tensor(depths, dtype=directions.dtype, device=directions.device).reshape(-1)
    if not holds(far > 0):
        raise ArgumentError(f"depths: expected metres above 0, got {far.tolist()}")
    return rig.points_seen(directions, far.reciprocal()).sum(-3)


@check_shapes
def seen_by(
    rig: CameraRig, directions: Float[Tensor, "V 3"], inverse_depth: Float[Tensor, "*#rigs V"]
) -> Int[Tensor, "*rigs V"]:
    """Number of cameras (*b, V) that see the surface points of a depth map.

    Fields of view, image borders and masks are considered, occlusion is not. Where fewer than two cameras see a
    point no parallax tells its depth.

    Args:
        rig: single, or a batch of rigs.
        directions: unit directions (V, 3) from the rig's centre in the world, of any grid.
        inverse_depth: (*b, V) in 1/m along them; 0 is infinity.

    Raises:
        ArgumentError: an inverse depth is negative.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> forward, up = [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]
        >>> tilted = ring_rig(4).rotated(tilt=0.6)  # fisheyes of 220° that look down by 34°
        >>> seen_by(tilted, torch.tensor([forward, up]), torch.tensor([1.0, 0.0])).tolist()
        [3, 0]
    """
    if not holds(inverse_depth >= 0):
        raise ArgumentError(
            f"inverse_depth: expected 1/m, 0 or more, got {inverse_depth.min().item():g}; leave unknown points at 0"
        )
    return rig.points_seen(directions, inverse_depth.unsqueeze(-2)).sum(-3).squeeze(-2)


@check_shapes
def overlap(counts: Int[Tensor, "*depths V"], solid_angles: Float[Tensor, " V"]) -> Overlap:
    """Overlap by solid angle from the ``counts`` (*, V) of ``coverage`` and the grid's ``solid_angles`` (V,).

    Examples:
        >>> seen, shared, mean = overlap(torch.tensor([[0, 1, 2, 3]]), torch.ones(4))
        >>> seen.item(), shared.item(), mean.item()
        (0.75, 0.5, 1.5)
    """
    weight = solid_angles / solid_angles.sum()
    return Overlap(
        ((counts >= 1) * weight).sum(-1), ((counts >= 2) * weight).sum(-1), (counts * weight).sum(-1)
    )
