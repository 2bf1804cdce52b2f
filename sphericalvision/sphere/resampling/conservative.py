# SPDX-License-Identifier: Apache-2.0
"""Resampling that keeps integrals: each value goes to the cells of the target that its own cell overlaps.

The areas of the overlaps are counted at samples of both grids. That is right to a few per cent of a cell, and then
made exact: factors 1 + λ of the targets + μ of the sources are solved for, with which the overlaps of every cell, of
either grid, sum to its solid angle. Sums over the sources are then means, and sums over the targets the integral.

References:
    P. Jones, "First- and second-order conservative remapping schemes for grids in spherical coordinates", Monthly
    Weather Review 127 (1999), for the weights; the balance of counted areas is a graph Laplacian's equation.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sphericalvision.cameras import Camera
from sphericalvision.core import ArgumentError
from sphericalvision.geometry.lookup import PlacesInSinglePrecision
from sphericalvision.sphere.grids.sphere_grid import SphereGrid
from sphericalvision.sphere.resampling.supersampling import cell_samples, cell_widths

__all__ = ["Overlaps", "overlaps"]

_PER_WIDTH = 4  # samples along a side of a cell, for each width of the other grid's cells
_TOLERANCE = 3e-13
_STEPS = 5000
_TURNS = 300
_FINENESS = (1, 4, 16)  # more samples are tried where overlaps were missed
_MOST_SAMPLES = 2**24
_LARGEST_GAP = 1e-4  # between the total solid angles of two grids, relative


class Overlaps(PlacesInSinglePrecision):
    """Results that are sums over overlaps: values ``(*b, C, *source)`` to ``(*b, C, targets)``."""

    targets: Tensor
    sources: Tensor
    weights: Tensor

    def __init__(
        self,
        targets: Int[Tensor, " m"],
        sources: Int[Tensor, " m"],
        weights: Float[Tensor, " m"],
        count: int,
        dims: int,
    ) -> None:
        super().__init__()
        self.count, self.dims = count, dims
        for name, table in (("targets", targets), ("sources", sources), ("weights", weights)):
            self.register_buffer(name, table, persistent=False)

    def forward(self, values: Float[Tensor, " ..."]) -> Float[Tensor, " ..."]:
        # Thousands of values added up one after the other in single precision are 1e-4 off.
        shares = values.flatten(-self.dims).index_select(-1, self.sources).double() * self.weights.double()
        total = shares.new_zeros(*shares.shape[:-1], self.count).index_add(-1, self.targets, shares)
        return total.to(values.dtype)


@torch.no_grad()
def overlaps(
    source: SphereGrid | Camera,
    target: SphereGrid | Camera,
    rotation: Float[Tensor, "3 3"] | None,
    device: torch.device,
) -> Overlaps:
    """The overlaps of two grids' cells, as shares of the target's.

    Raises:
        ArgumentError: source or target is a camera or covers another part of the sphere than the other, the target's
            cells overlap, or there is a rotation for each of a batch.
    """
    if isinstance(source, Camera) or isinstance(target, Camera):
        name, camera = ("source", source) if isinstance(source, Camera) else ("target", target)
        raise ArgumentError(
            f"{name}: mode 'conservative' is between grids, whose cells cover the sphere, got a "
            f"{type(camera).__name__}; take mode 'area'"
        )
    if rotation is not None and rotation.ndim > 2:
        raise ArgumentError(
            f"rotation: mode 'conservative' takes one, (3, 3), got {tuple(rotation.shape)}; resample one at a time"
        )
    areas = [grid.solid_angles.flatten().to(device=device, dtype=torch.float64) for grid in (target, source)]
    totals = [float(area.sum()) for area in areas]
    if abs(totals[0] - totals[1]) > _LARGEST_GAP * totals[0]:
        raise ArgumentError(
            f"source, target: expected grids of the same part of the sphere, got {totals[1]:.4g} and {totals[0]:.4g} "
            "steradians; take mode 'area'"
        )
    if not bool((areas[0] > 0).all()):
        raise ArgumentError(
            f"target: mode 'conservative' needs cells that do not overlap, those of {type(target).__name__} do; take "
            "mode 'area'"
        )
    areas[1] = areas[1] * (totals[0] / totals[1])  # not in place: they may be the grid's own
    turn = torch.eye(3, dtype=torch.float64, device=device) if rotation is None else rotation.double()
    for fineness in _FINENESS:
        ahead = _counted(target, source, turn, areas[0], fineness)
        back = _counted(source, target, turn.T, areas[1], fineness)
        count = len(areas[1])
        pairs = torch.cat((ahead[0] * count + ahead[1], back[1] * count + back[0]))
        pairs, place = pairs.unique(return_inverse=True)
        size = torch.zeros_like(pairs, dtype=torch.float64)
        size.index_add_(0, place, torch.cat((ahead[2], back[2])) / 2)
        targets, sources = torch.div(pairs, count, rounding_mode="floor"), pairs % count
        balanced = _balanced(targets, sources, size, *areas)
        if balanced is not None:
            weights = balanced / areas[0][targets]
            return Overlaps(targets, sources, weights, len(areas[0]), len(tuple(source.shape)))
    raise ArgumentError(
        "source, target: the cells of one grid overlap each other or leave gaps, so that no weights keep integrals; "
        "take mode 'area'"
    )


def _counted(
    grid: SphereGrid, other: SphereGrid, turn: Tensor, areas: Tensor, fineness: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Cells of a grid, the other's cells in which their samples lie, and what each sample stands for."""
    ratio = float(cell_widths(grid).max() / cell_widths(other).min().clamp_min(1e-9))
    samples = max(2, math.ceil(_PER_WIDTH * min(ratio, 64.0)))
    samples = max(samples, min(fineness * samples, math.isqrt(_MOST_SAMPLES // len(areas))))
    cells = cell_samples(grid, samples, torch.float64, turn.device)
    others = other.nearest(cells.directions @ turn)  # the transpose, on rows
    own = torch.arange(len(areas), device=turn.device)[:, None].expand_as(others)
    return own.flatten(), others.flatten(), (cells.shares * areas[:, None]).flatten()


def _balanced(
    targets: Tensor, sources: Tensor, size: Tensor, target_areas: Tensor, source_areas: Tensor
) -> Tensor | None:
    """Overlaps (m,) changed so that they sum to the areas and stay positive, or None where such were not found."""
    split = len(target_areas)
    areas = torch.cat((target_areas, source_areas))

    def sums(values: Tensor) -> Tensor:
        """Of values (m,), over targets and over sources."""
        total = torch.zeros_like(areas).index_add_(0, targets, values)
        return total.index_add_(0, sources + split, values)

    def changed() -> Tensor | None:
        """The overlaps times factors 1 + λ + μ, by conjugate gradients."""
        diagonal = sums(size).clamp_min(torch.finfo(areas.dtype).tiny)
        factors, missing = torch.zeros_like(areas), areas - sums(size)
        scaled = missing / diagonal
        step, length = scaled, missing @ scaled
        for _ in range(_STEPS):
            if bool((missing.abs() <= _TOLERANCE * areas).all()):
                break
            change = sums(size * (step[targets] + step[sources + split]))
            along = length / (step @ change)
            factors = factors + along * step
            missing = missing - along * change
            scaled = missing / diagonal
            step, length = scaled + (missing @ scaled) / length * step, missing @ scaled
        result = size * (1 + factors[targets] + factors[sources + split])
        fits = (areas - sums(result)).abs() <= 1e4 * _TOLERANCE * areas
        positive = (result > 0) | (size == 0)
        return result if bool(positive.all()) and bool(fits.all()) else None

    if (result := changed()) is not None:
        return result
    # Of few and large cells sums of factors may be negative. Products, of targets and of sources in turns, never are,
    # and come close enough that the sums are positive.
    for _ in range(_TURNS):
        size = size * (areas / sums(size))[targets]
        size = size * (areas / sums(size))[sources + split]
    return changed()
