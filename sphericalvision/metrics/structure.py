# SPDX-License-Identifier: Apache-2.0
"""Structure of a depth map: edges, thin things and flat surfaces."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sphericalvision.geometry.lookup import read_entries
from sphericalvision.icosphere import icosphere_rings, icosphere_vertices, level_from_num_vertices
from sphericalvision.tables import constant_table


class DepthStructure(NamedTuple):
    """Masks of edges, thin things and flat surfaces, each ``(*, V)``; they may overlap or leave points out."""

    edge: Bool[Tensor, "*batch V"]
    thin: Bool[Tensor, "*batch V"]
    flat: Bool[Tensor, "*batch V"]


def depth_structure(
    index: Float[Tensor, "*batch V"], step: float = 0.8, bend: float = 0.02
) -> DepthStructure:
    """Return the edges, thin things and flat surfaces of a true depth map.

    * *edge*: within one ring of vertices the index spreads by more than ``step``;
    * *thin*: nearer by more than ``step`` than the opening of the map by two rings: narrower than about four times the
      distance between vertices;
    * *flat*: not at an edge, and within two rings a plane, up to ``bend``. The inverse depth of a plane along the ray
      is a linear function of the direction, so this is a linear fit.

    Args:
        index: ``(*, V)`` of hypotheses, proportional to inverse depth, on an icosphere.
        step: in hypotheses; 0.8 is 5 % of N = 16.
        bend: largest distance from the plane that fits best, in hypotheses.

    Examples:
        >>> from sphericalvision.icosphere import Icosphere
        >>> vertices = Icosphere(5).vertices
        >>> floor = (8 * vertices[:, 1]).clamp(min=0)  # a plane below, and nothing above
        >>> structure = depth_structure(floor)
        >>> bool(structure.flat[-1]), bool(structure.edge.any()), bool(structure.thin.any())
        (True, False, False)
    """
    level = level_from_num_vertices(index.shape[-1])
    near, wide = _rings(level, 1, index.device), _rings(level, 2, index.device)
    nearest, farthest = _most(index, near), -_most(-index, near)
    eroded = -_most(-index, wide)
    flat = _off_plane(index, wide) <= bend
    edge = nearest - farthest > step
    return DepthStructure(edge, index - _most(eroded, wide) > step, flat & ~edge)


def local_contrast(image: Float[Tensor, "*batch C V"]) -> Float[Tensor, "*batch V"]:
    """Return the standard deviation ``(*, V)`` of the brightness of an image on an icosphere, within two rings.

    Examples:
        >>> local_contrast(torch.full((3, 162), 0.3)).max().item() < 1e-6
        True
    """
    grey = image.mean(-2)
    rings = _rings(level_from_num_vertices(grey.shape[-1]), 2, grey.device)
    valid = rings >= 0
    around = grey[..., rings.clamp(min=0)]
    count = valid.sum(-1)
    mean = (around * valid).sum(-1) / count
    return (((around - mean[..., None]).square() * valid).sum(-1) / count).sqrt()


def _most(values: Tensor, rings: Tensor) -> Tensor:
    """The greatest of the values ``(*, V)`` within rings ``(V, k)``, whose missing entries are -1."""
    return read_entries(values, rings.clamp(min=0)).where(rings >= 0, -torch.inf).amax(-1)


def _off_plane(index: Tensor, rings: Tensor) -> Tensor:
    """Largest residual ``(*, V)`` within rings of a linear function of the direction that fits best."""
    level = level_from_num_vertices(index.shape[-1])
    valid = (rings >= 0).to(torch.float64)[..., None]
    vertices = icosphere_vertices(level, torch.float64, index.device)[rings.clamp(min=0)] * valid
    values = index.double()[..., rings.clamp(min=0)] * valid[..., 0]
    # (V, 3, 3), well away from singular: directions are unit vectors that differ
    normal = vertices.mT @ vertices
    slope = torch.linalg.solve(normal, (vertices.mT @ values[..., None]))
    return (values - (vertices @ slope)[..., 0]).abs().amax(-1).to(index.dtype)


@constant_table
def _rings(level: int, number: int, device: torch.device) -> Int[Tensor, "V k"]:
    return icosphere_rings(level, number).to(device)
