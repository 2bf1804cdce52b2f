# SPDX-License-Identifier: Apache-2.0
"""Masks of evaluation: points that enough cameras see, and the surroundings of the grids' seams."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from sphericalvision.cameras import CameraRig, seen_by
from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import icosphere_vertices
from sphericalvision.icosphere.topology import vertex_at
from sphericalvision.shapes import check_shapes


class EvaluationMask(NamedTuple):
    """Points ``(B, V)`` where errors count, and the share ``(B,)`` of valid points that were left out, 0 to 1."""

    mask: Bool[Tensor, "B V"]
    left_out: Float[Tensor, " B"]


@check_shapes
def evaluation_mask(
    rig: CameraRig,
    directions: Float[Tensor, "V 3"],
    inverse_depth: Float[Tensor, "B V"],
    valid: Shaped[Tensor, "B V"] | None = None,
) -> EvaluationMask:
    """Leave out points that fewer than two cameras see, whose depth no parallax shows.

    Args:
        rig: of all images, or a batch of rigs.
        directions: ``(V, 3)`` unit directions from the rig's centre, of any grid.
        inverse_depth: true ones ``(B, V)`` in 1/m; 0 is infinity.
        valid: ``(B, V)``, True where there is a truth; everywhere when not given.

    Returns:
        The mask, and the share of valid points left out, not weighted by solid angle; NaN for an image without any.

    References:
        Komatsu et al. (2020), section IV-C: tilted cameras leave the sky to fewer than two.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> ring = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]
        >>> infinity = torch.zeros(1, 4)
        >>> mask, left_out = evaluation_mask(ring_rig(4).rotated(tilt=0.6), torch.tensor(ring), infinity)
        >>> mask, left_out  # nobody sees what is above
        (tensor([[ True,  True,  True, False]]), tensor([0.2500]))
    """
    valid = torch.ones_like(inverse_depth, dtype=torch.bool) if valid is None else valid.bool()
    masked = torch.where(valid, inverse_depth, 0.0)
    mask = valid & (seen_by(rig, directions, masked) >= 2)
    return EvaluationMask(mask, 1 - mask.sum(1) / valid.sum(1))


@check_shapes
def seam_mask(
    directions: Float[Tensor, "*batch 3"], angle: float = math.radians(5)
) -> Bool[Tensor, "*batch"]:
    """Return which directions are near a seam of the networks' grids, where errors should be no larger than elsewhere.

    Seams are the borders of the icosphere's five charts, 15 edges of the icosahedron, and the meridian straight behind
    (-z), where an equirectangular panorama is cut, with both poles.

    Args:
        directions: ``(*, 3)`` of any length but zero.
        angle: distance from the seam in radians, above 0 up to π/2.

    Returns:
        ``(*)`` bool.

    Raises:
        ArgumentError: if the angle is out of range.

    Examples:
        >>> up, behind, ahead = [0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [0.3, 0.0, 1.0]
        >>> seam_mask(torch.tensor([up, behind, ahead]))
        tensor([ True,  True, False])
    """
    if not 0 < angle <= math.pi / 2:
        raise ArgumentError(f"angle: expected more than 0, up to π / 2 radians, got {angle!r}")
    arcs = torch.cat((_chart_borders(), _meridian_behind())).to(directions.device)
    return _near_arcs(F.normalize(directions.double(), dim=-1), arcs, angle)


def _chart_borders() -> Tensor:
    """Ends ``(15, 2, 3)`` of the edges of the icosahedron between charts: three on the north-east side of each."""
    chart = torch.arange(5)[:, None]
    row, column = torch.tensor([[0, 0, 1, 2], [0, 1, 1, 1]])
    corners = icosphere_vertices(0, torch.float64)[vertex_at(chart, row, column, level=0)]
    return torch.stack((corners[:, :-1], corners[:, 1:]), 2).flatten(0, 1)


def _meridian_behind() -> Tensor:
    """Ends ``(2, 2, 3)`` of the quarters from straight behind to the poles."""
    behind, up = torch.tensor([0.0, 0.0, -1.0]), torch.tensor([0.0, -1.0, 0.0])
    return torch.stack((torch.stack((behind, up)), torch.stack((behind, -up)))).double()


def _near_arcs(unit: Tensor, arcs: Tensor, angle: float) -> Tensor:
    """Whether unit vectors ``(*, 3)`` lie within an angle of great-circle arcs ``(A, 2, 3)`` shorter than π."""
    first, last = arcs.unbind(1)
    normal = F.normalize(torch.linalg.cross(first, last), dim=-1)
    height = unit @ normal.T  # sine of the angle from the arc's plane
    # Between the two ends: left of the plane through the first end, right of the one through the last.
    inside = (unit @ torch.linalg.cross(normal, first).T >= 0) & (
        unit @ torch.linalg.cross(last, normal).T >= 0
    )
    along = inside & (height.abs() <= math.sin(angle) + 1e-9)
    ends = unit @ arcs.flatten(0, 1).T >= math.cos(angle) - 1e-9
    return along.any(-1) | ends.any(-1)
