# SPDX-License-Identifier: Apache-2.0
"""Where each value of a target looks in a source, worked out once."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from sphericalvision.cameras import Camera
from sphericalvision.core import ArgumentError, ShapeError, check_choice
from sphericalvision.sphere.grids.base import SphereGrid
from sphericalvision.sphere.grids.values import check_values
from sphericalvision.sphere.resampling.lookups import IndexLookup, make_lookup, nearest_index
from sphericalvision.sphere.resampling.supersampling import cell_samples, cell_widths, grid_shape

__all__ = ["RESAMPLE_MODES", "ResampleTables"]

RESAMPLE_MODES = ("bilinear", "nearest", "area")
"""What ``resample`` knows."""

_TOUCHED = 1e-3  # the least weight of usable values in what a result is made of
_SLACK = 0.25  # samples may lie this much further apart than the source's values, so that turning adds none


class ResampleTables(nn.Module):
    """Tables of one pair of grids or cameras, with gradients by rotation and intrinsics where these have them.

    The arguments are those of ``resample``; tables lie on ``device``.
    """

    usable: Tensor | None
    valid: Tensor | None
    gain: Tensor | None

    def __init__(
        self,
        source: SphereGrid | Camera,
        target: SphereGrid | Camera,
        rotation: Tensor | None,
        mode: str,
        fill: float,
        device: torch.device,
    ) -> None:
        super().__init__()
        # In double precision, so that values, masks and modules agree about what lies on a border.
        dtype = torch.float32 if device.type == "mps" else torch.float64
        check_choice("mode", mode, RESAMPLE_MODES)
        self.source_shape, self.target_shape = grid_shape(source, "source"), grid_shape(target, "target")
        self.mode, self.fill = mode, fill
        if rotation is not None:
            rotation = _checked_rotation(rotation).to(device=device, dtype=dtype)

        usable = gain = valid = None
        dims = len(self.source_shape)
        if rotation is None and _same(source, target):  # each value is its own, also where patches overlap
            self.lookup: nn.Module = IndexLookup(
                torch.arange(math.prod(self.source_shape), device=device), dims
            )
        else:
            directions, shares, whole = _looks(source, target, rotation, mode, dtype, device)
            if mode == "nearest":
                self.lookup = IndexLookup(nearest_index(source, directions.squeeze(-2)), dims)
            else:
                self.lookup = make_lookup(source, directions, shares, whole and shares.shape[-1] == 1)
            valid = None if whole else (shares > 0).any(-1)
        if isinstance(source, Camera):
            usable = source.unproject(source.pixel_grid(dtype).to(device)).valid
        for name, table in (("usable", usable), ("valid", valid)):
            self.register_buffer(name, table, persistent=False)
        if valid is not None:
            everywhere = torch.ones(self.source_shape, dtype=torch.bool, device=device)
            gain, valid = self._weigh(everywhere if usable is None else usable, dtype)
            self.valid = None if bool(valid.all()) else valid
        self.register_buffer("gain", gain, persistent=False)

    def forward(self, values: Tensor, mask: Tensor | None = None) -> Tensor:
        """Values ``(*b, c, *source_shape)`` on the target, ``(*b, c, *target_shape)``."""
        check_values(values, self.source_shape)
        if not values.is_floating_point() and self.mode != "nearest":
            raise ArgumentError(
                f"values: expected floating point numbers for mode {self.mode!r}, got {values.dtype}; convert them, "
                "or use mode 'nearest' for labels"
            )
        gain, valid, usable, result = self.gain, self.valid, self.usable, values
        weighted = not isinstance(self.lookup, IndexLookup)
        if weighted:
            result = values.to(torch.promote_types(values.dtype, torch.float32))
        if mask is not None:
            usable = self._checked_mask(mask)
            gain, valid = self._weigh(usable, result.dtype)
        if weighted and usable is not None:
            result = torch.where(usable.unsqueeze(-len(self.source_shape) - 1), result, 0.0)
        result = self.lookup(result)
        if gain is not None:
            result = result * gain.to(result.dtype).unsqueeze(-2)
        if valid is not None:
            result = torch.where(valid.unsqueeze(-2), result, self._filling(result))
        return result.to(values.dtype).unflatten(-1, self.target_shape)

    def mask(self, mask: Tensor | None = None) -> Tensor:
        """Where results are valid, bool ``(*b, *target_shape)``, given the values that may be used."""
        valid = self.valid if mask is None else self._weigh(self._checked_mask(mask), torch.float32)[1]
        if valid is None:
            device = next(self.buffers()).device
            return torch.ones(self.target_shape, dtype=torch.bool, device=device)
        return valid.unflatten(-1, self.target_shape)

    def _weigh(self, usable: Tensor, dtype: torch.dtype) -> tuple[Tensor | None, Tensor]:
        """One over the weight of usable values in each result (*b, n), and where there is enough of it."""
        usable = usable.unsqueeze(-len(self.source_shape) - 1)
        gain = None
        if isinstance(self.lookup, IndexLookup):
            touched = self.lookup(usable).squeeze(-2)
        else:
            weight = self.lookup(usable.to(dtype)).squeeze(-2)
            touched = weight > _TOUCHED
            gain = torch.where(touched, 1 / torch.where(touched, weight, 1.0), 0.0)
        return gain, touched if self.valid is None else touched & self.valid

    def _checked_mask(self, mask: Tensor) -> Tensor:
        dims = len(self.source_shape)
        if mask.ndim < dims or tuple(mask.shape[mask.ndim - dims :]) != self.source_shape:
            size = ", ".join(map(str, self.source_shape))
            raise ShapeError(f"mask: expected shape (*b, {size}) as the source, got {tuple(mask.shape)}")
        return mask != 0 if self.usable is None else (mask != 0) & self.usable

    def _filling(self, result: Tensor) -> Tensor:
        if not result.is_floating_point() and self.fill != int(self.fill):
            raise ArgumentError(f"fill: expected a whole number for {result.dtype}, got {self.fill}")
        return torch.full_like(result[..., :1, :1], self.fill)


class _Looks(NamedTuple):
    directions: Tensor
    """Of each target's samples in the source's frame (*b, n, s, 3)."""
    shares: Tensor
    """Of each sample in its target (*b, n, s); zero where source or target see nothing."""
    whole: bool
    """Whether neither source nor target is a camera."""


def _looks(
    source: SphereGrid | Camera,
    target: SphereGrid | Camera,
    rotation: Tensor | None,
    mode: str,
    dtype: torch.dtype,
    device: torch.device,
) -> _Looks:
    cells = cell_samples(target, 1, dtype, device)
    directions, in_view = _turned(cells.directions, rotation), cells.valid
    samples = _samples(source, target, directions, in_view) if mode == "area" else 1
    if samples > 1:
        cells = cell_samples(target, samples, dtype, device)
        directions = _turned(cells.directions, rotation)
    shares = cells.shares
    if (
        cells.valid is not None and in_view is not None
    ):  # a pixel out of view stays so, though a corner may be in it
        shares = torch.where(cells.valid & in_view, shares, 0.0)
    inside = source.project(directions).valid if isinstance(source, Camera) else None
    if hasattr(source, "contains") and not isinstance(source, Camera):
        inside = source.contains(directions)
        inside = None if bool(inside.all()) else inside
    if inside is not None:
        shares = torch.where(inside, shares, 0.0)
    return _Looks(directions, shares, cells.valid is None and inside is None)


def _turned(directions: Tensor, rotation: Tensor | None) -> Tensor:
    """Directions (n, s, 3) of the target in the source's frame, (*b, n, s, 3)."""
    if rotation is None:
        return directions
    # target_from_source turns the other way: its transpose acts on column vectors, itself on rows.
    return directions @ rotation.unsqueeze(-3)


def _checked_rotation(rotation: Tensor) -> Tensor:
    if rotation.ndim < 2 or tuple(rotation.shape[-2:]) != (3, 3):
        raise ShapeError(f"rotation: expected shape (3, 3) or (*b, 3, 3), got {tuple(rotation.shape)}")
    return rotation


@torch.no_grad()
def _samples(
    source: SphereGrid | Camera, target: SphereGrid | Camera, directions: Tensor, in_view: Tensor | None
) -> int:
    """How many samples along a side of the target's cells lie about as close as the source's values."""
    there = nearest_index(source, directions.squeeze(-2))
    ratio = cell_widths(target).to(directions) / cell_widths(source).to(directions)[there]
    seen = ratio.isfinite()
    if isinstance(source, Camera):
        seen = seen & source.project(directions).valid.squeeze(-1)
    if in_view is not None:
        seen = seen & in_view.squeeze(-1)
    return max(1, math.ceil(float(torch.where(seen, ratio, 0.0).max()) - _SLACK))


def _same(source: SphereGrid | Camera, target: SphereGrid | Camera) -> bool:
    """Whether two grids are the same."""
    if isinstance(source, Camera) or isinstance(target, Camera) or type(source) is not type(target):
        return False
    return tuple(source.shape) == tuple(target.shape) and torch.equal(
        source.directions.to(target.directions), target.directions
    )
