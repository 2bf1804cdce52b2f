# SPDX-License-Identifier: Apache-2.0
"""Values on an icosphere on the next coarser level (pooling) and on the next finer one (linear interpolation)."""

from __future__ import annotations

import torch
from jaxtyping import Float, Num
from torch import Tensor, nn

from sphericalvision.core import ShapeError, check_choice, check_floating
from sphericalvision.geometry.lookup import read_entries
from sphericalvision.icosphere.adjacency import icosphere_neighbors
from sphericalvision.icosphere.areas import icosphere_solid_angles
from sphericalvision.icosphere.hierarchy import icosphere_vertex_parents
from sphericalvision.icosphere.topology import (
    check_level,
    coarse_vertex_ids,
    level_from_num_vertices,
    num_icosphere_vertices,
)
from sphericalvision.shapes import check_shapes
from sphericalvision.tables import constant_table

POOL_MODES = ("mean", "max")


@check_shapes
def icosphere_pool(values: Num[Tensor, "*batch V"], mode: str = "mean") -> Num[Tensor, "*batch V_coarse"]:
    """Pool values on the vertices of the next coarser icosphere.

    Each kept vertex gathers itself and its neighbours, six or, at the twelve vertices of the icosahedron, five.

    Args:
        values: ``(*, V)``, floating point for ``"mean"``.
        mode: ``"mean"`` weighs by solid angle; a vertex halfway between two kept ones counts half for each, so no
            value is counted more than once and the pooled values have the integral of the values. ``"max"`` takes
            the largest.

    Returns:
        ``(*, V_coarse)``.

    Examples:
        >>> icosphere_pool(torch.ones(2, 162)).shape
        torch.Size([2, 42])
    """
    check_choice("mode", mode, POOL_MODES)
    level = level_from_num_vertices(values.shape[-1])
    ids = _pooled_ids(level, values.device)
    if mode == "max":
        return values[..., ids].amax(-1)
    check_floating("values", values)
    weights = _pool_weights(level, values.dtype, values.device)
    result = values[..., ids[:, 0]] * weights[:, 0]
    for k in range(1, 7):  # one after the other: seven times the coarse values need not fit in memory at once
        result = result + values[..., ids[:, k]] * weights[:, k]
    return result


class IcospherePool(nn.Module):
    """Pooling from one level to the next coarser one; see ``icosphere_pool``.

    Args:
        level: of the values given, 1 or more.
        mode: ``"mean"`` by solid angle, or ``"max"``.

    Examples:
        >>> pool = IcospherePool(level=2, mode="max")
        >>> pool, pool(torch.rand(8, 162)).shape
        (IcospherePool(level=2, mode='max'), torch.Size([8, 42]))
    """

    def __init__(self, level: int, mode: str = "mean") -> None:
        super().__init__()
        check_choice("mode", mode, POOL_MODES)
        self.level, self.mode = check_level(level, 1), mode

    def forward(self, values: Num[Tensor, "*batch V"]) -> Num[Tensor, "*batch V_coarse"]:
        _check_level_of(values, self.level)
        return icosphere_pool(values, self.mode)

    def extra_repr(self) -> str:
        return f"level={self.level}, mode={self.mode!r}"


@check_shapes
def icosphere_upsample(values: Float[Tensor, "*batch V"]) -> Float[Tensor, "*batch V_fine"]:
    """Interpolate values on the next finer icosphere: new vertices get the mean of the edge that they halve.

    This is exactly the linear interpolation on the triangles, as by ``Icosphere.sample``.

    Args:
        values: ``(*, V)``, floating point.

    Returns:
        ``(*, V_fine)``.

    Examples:
        >>> icosphere_upsample(torch.ones(2, 42)).shape
        torch.Size([2, 162])
    """
    parents = _parents(level_from_num_vertices(values.shape[-1]), values.device)
    return (read_entries(values, parents[:, 0]) + read_entries(values, parents[:, 1])) / 2


@constant_table
def _parents(level: int, device: torch.device) -> Tensor:
    return icosphere_vertex_parents(level + 1, device)


class IcosphereUpsample(nn.Module):
    """Interpolation from one level to the next finer one; see ``icosphere_upsample``.

    Args:
        level: of the values given.

    Examples:
        >>> IcosphereUpsample(level=1)(torch.rand(8, 42)).shape
        torch.Size([8, 162])
    """

    def __init__(self, level: int) -> None:
        super().__init__()
        self.level = check_level(level)

    def forward(self, values: Float[Tensor, "*batch V"]) -> Float[Tensor, "*batch V_fine"]:
        _check_level_of(values, self.level)
        return icosphere_upsample(values)

    def extra_repr(self) -> str:
        return f"level={self.level}"


def _check_level_of(values: Tensor, level: int) -> None:
    if values.shape[-1] != num_icosphere_vertices(level):
        raise ShapeError(
            f"values: expected shape (*, {num_icosphere_vertices(level)}) for an icosphere of level {level}, "
            f"got {tuple(values.shape)}"
        )


@constant_table
def _pooled_ids(level: int, device: torch.device) -> Tensor:
    """Return what each kept vertex gathers: itself, then its neighbours; itself again where there are five."""
    coarse = coarse_vertex_ids(level, device)[:, None]
    around = icosphere_neighbors(level, device)[coarse[:, 0]]
    return torch.cat((coarse, torch.where(around < 0, coarse, around)), 1)


@constant_table
def _pool_weights(level: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the weights ``(V_coarse, 7)`` of a mean by solid angle."""
    ids = _pooled_ids(level, device)
    weights = icosphere_solid_angles(level, torch.float64, device)[ids]
    weights[:, 1:] *= 0.5  # halfway to the next kept vertex
    weights[:, 1:] *= ids[:, 1:] != ids[:, :1]
    return (weights / weights.sum(1, keepdim=True)).to(dtype)
