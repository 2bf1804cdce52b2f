# SPDX-License-Identifier: Apache-2.0
"""The tables behind ``resample`` and ``Resample``: where each value of a target looks in a source."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, Shaped
from torch import Tensor, nn

from sphericalvision.cameras import Camera
from sphericalvision.cameras.checks import check_rotation
from sphericalvision.cameras.remapping.area import (
    CellGroup,
    PyramidLookup,
    cell_groups,
    footprint,
    lookup_at_level,
)
from sphericalvision.cameras.remapping.lookup import nearest_pixel
from sphericalvision.core import check_choice, check_tensor, check_type
from sphericalvision.geometry.image_lookup import image_lookup
from sphericalvision.geometry.lookup import Lookup, PlacesInSinglePrecision
from sphericalvision.geometry.masked_lookup import MaskedLookup, check_mask
from sphericalvision.sphere.grids.equirectangular import Equirectangular
from sphericalvision.sphere.grids.sphere_grid import SphereGrid
from sphericalvision.sphere.resampling.supersampling import cell_samples, cell_widths, grid_shape

RESAMPLE_MODES = ("bilinear", "nearest", "area")
"""What ``resample`` knows."""


def resample_tables(
    source: SphereGrid | Camera,
    target: SphereGrid | Camera,
    rotation: Float[Tensor, "*turns 3 3"] | None,
    mode: str,
    fill: float,
    mask: Shaped[Tensor, " ..."] | None,
    device: torch.device,
    dtype: torch.dtype = torch.float64,
) -> MaskedLookup:
    """Tables of one pair of grids or cameras, with gradients by rotation and intrinsics where these have them.

    They are computed in ``dtype``, that of the values, where every direction is seen; else in double precision, so that
    values, masks and modules agree about what lies on a border.
    """
    check_choice("mode", mode, RESAMPLE_MODES)
    source_shape, target_shape = grid_shape(source, "source"), grid_shape(target, "target")
    check_type("fill", fill, (int, float))
    if rotation is not None:
        check_rotation("rotation", rotation)
    if mask is not None:
        check_tensor("mask", mask, f"(*b, {', '.join(map(str, source_shape))})")
    if device.type == "meta":
        return _shapes_only(source_shape, target_shape, rotation, mode, fill)
    bordered = mask is not None or not (_is_whole(source) and _is_whole(target))
    if bordered or mode != "bilinear" or not dtype.is_floating_point:
        dtype = torch.float64
    dtype = torch.float32 if device.type == "mps" else torch.promote_types(dtype, torch.float32)
    usable = None if mask is None else mask.to(device)
    dims = len(source_shape)
    if rotation is None and _same(source, target):  # each value is its own, also where patches overlap
        everything = Lookup(torch.arange(math.prod(source_shape), device=device), dims=dims)
        return MaskedLookup(everything, source_shape, target_shape, mode, fill, None, usable)
    if rotation is not None:
        rotation = rotation.to(device=device, dtype=dtype)
    middles = _samples(source, target, rotation, dtype, device)
    groups = cell_groups(_spans(source, target, middles), _image_size(source)) if mode == "area" else []
    averages = any(group.level or group.samples != (1, 1) for group in groups)
    if mode == "nearest":
        lookup: nn.Module = Lookup(nearest_index(source, middles.directions.squeeze(-2)), dims=dims)
    elif averages:

        def group_lookup(group: CellGroup) -> nn.Module:
            samples = _samples(source, target, rotation, dtype, device, group, middles.in_view)
            return make_lookup(source, samples.directions, samples.shares, group.level)

        # One group at level 0, such as grids have, is in order as it is.
        alone = len(groups) == 1 and not groups[0].level
        lookup = group_lookup(groups[0]) if alone else PyramidLookup(groups, group_lookup)
    else:
        lookup = make_lookup(source, middles.directions, middles.shares)
    if usable is not None:
        check_mask(usable, source_shape)
    if isinstance(source, Camera):
        seen = source.unproject(source.pixel_grid(dtype).to(device)).valid
        usable = seen if usable is None else usable * seen
    # Where samples are averaged, what counts is whether enough of them see something.
    valid = None if middles.whole or averages else (middles.shares > 0).any(-1)
    summed = middles.whole or not averages
    return MaskedLookup(lookup, source_shape, target_shape, mode, fill, valid, usable, summed)


def _shapes_only(
    source_shape: tuple[int, ...],
    target_shape: tuple[int, ...],
    rotation: Tensor | None,
    mode: str,
    fill: float,
) -> MaskedLookup:
    """On the meta device, where nothing has a value: a table of the right size that points anywhere."""
    batch = () if rotation is None else rotation.shape[:-2]
    ids = torch.empty(*batch, math.prod(target_shape), dtype=torch.long, device="meta")
    return MaskedLookup(Lookup(ids, dims=len(source_shape)), source_shape, target_shape, mode, fill)


class _Samples(NamedTuple):
    directions: Tensor
    """Of each cell's samples in the source's frame (*b, n, s, 3)."""
    shares: Tensor
    """Of each sample in its cell (*b, n, s); zero where source or target see nothing."""
    in_view: Tensor | None
    """Whether a camera that is the target sees them (n, s); None for a grid."""
    whole: bool
    """Whether source and target see all of them."""


def _samples(
    source: SphereGrid | Camera,
    target: SphereGrid | Camera,
    rotation: Tensor | None,
    dtype: torch.dtype,
    device: torch.device,
    group: CellGroup | None = None,
    middle_in_view: Tensor | None = None,
) -> _Samples:
    """Samples of a group of the target's cells, or the middles of all."""
    samples, chosen = (1, None) if group is None else (group.samples, group.cells)
    cells = cell_samples(target, samples, dtype, device, chosen)
    directions, weights = cells.directions, cells.shares
    if rotation is not None:
        # target_from_source turns the other way: its transpose acts on column vectors, itself on rows.
        directions = directions @ rotation.unsqueeze(-3)
    if cells.valid is not None:
        weights = torch.where(cells.valid, weights, 0.0)
    if group is not None and middle_in_view is not None:
        # A pixel out of view stays so, though a corner may be in it.
        weights = torch.where(middle_in_view[group.cells], weights, 0.0)
    inside = _seen_by(source, directions)
    if inside is not None:
        weights = torch.where(inside, weights, 0.0)
    return _Samples(directions, weights, cells.valid, cells.valid is None and inside is None)


def _seen_by(source: SphereGrid | Camera, directions: Tensor) -> Tensor | None:
    """Where a source has values (*), of directions (*, 3); None for everywhere."""
    if isinstance(source, Camera):
        return source.project(directions).valid
    if _is_whole(source):
        return None
    inside: Tensor = source.contains(directions)  # type: ignore[attr-defined]
    return None if bool(inside.all()) else inside


@torch.no_grad()
def _spans(source: SphereGrid | Camera, target: SphereGrid | Camera, middles: _Samples) -> Tensor:
    """How many of the source's values a cell of the target spans along its two sides (n, 2), the most of a batch."""
    directions, seen = middles.directions.squeeze(-2), middles.shares.squeeze(-1) > 0
    if isinstance(source, Camera) and isinstance(target, Camera):
        pixels = source.project(directions).pixels.unflatten(-2, target.image_size)
        return footprint(pixels, seen.unflatten(-1, target.image_size), source).flatten(0, 1)
    nearest = nearest_index(source, directions)
    ratio = cell_widths(target).to(directions) / cell_widths(source).to(directions)[nearest]
    ratio = torch.where(seen & ratio.isfinite(), ratio, 0.0)
    return ratio.reshape(-1, ratio.shape[-1]).amax(0).unsqueeze(-1).expand(-1, 2)


def _image_size(source: SphereGrid | Camera) -> tuple[int, int] | None:
    """(height, width) of a source whose values are one image without seams inside, which can be made smaller."""
    if isinstance(source, Camera):
        return source.image_size
    return source.shape if isinstance(source, Equirectangular) else None


def _is_whole(grid: SphereGrid | Camera) -> bool:
    """Whether a grid has no borders."""
    covers: bool = getattr(grid, "whole_sphere", not hasattr(grid, "contains"))
    return covers and not isinstance(grid, Camera)


def _same(source: SphereGrid | Camera, target: SphereGrid | Camera) -> bool:
    """Whether two grids are the same."""
    if isinstance(source, Camera) or isinstance(target, Camera) or type(source) is not type(target):
        return False
    return tuple(source.shape) == tuple(target.shape) and torch.equal(
        source.directions.to(target.directions), target.directions
    )


def make_lookup(
    source: SphereGrid | Camera,
    directions: Float[Tensor, " ..."],
    shares: Float[Tensor, " ..."],
    level: int = 0,
) -> nn.Module:
    """A lookup of the source's interpolated values: values (*b, c, *source_shape) to (*b, c, n).

    Args:
        source: grid or camera.
        directions: of s samples for each of n targets (*g, n, s, 3), of any length.
        shares: of every sample in its target (*g, n, s); zero for samples that are not to be read.
        level: how often the source's values, an image, are halved.
    """
    seen = shares > 0
    same = ~seen | (shares == 1 / shares.shape[-1])  # a mean needs no table of shares
    averaged = None if bool(same.all()) else shares
    if isinstance(source, Camera):
        pixels = source.project(directions).pixels
        return lookup_at_level(pixels, seen, source.image_size, level, source.edges, averaged)
    if isinstance(source, Equirectangular):
        pixels = source.image_pixels(directions)
        return lookup_at_level(pixels, seen, source.shape, level, source.image_edges, averaged)
    if hasattr(source, "image_pixels"):
        return _GridImageLookup(source, source.image_pixels(directions), seen, averaged)
    taps = getattr(source, "taps", None) or getattr(source, "locate", None)
    if taps is None:
        return _DirectionLookup(source, directions, shares)
    ids, weights = taps(directions)
    ids, weights = ids.flatten(-2), (weights * shares.unsqueeze(-1)).flatten(-2)
    if directions.shape[-2] > 1 and not weights.requires_grad:
        ids, weights = _merged(ids, weights)
    return Lookup(ids, weights, None if bool(seen.all()) else seen.any(-1), len(source.shape))


def nearest_index(
    source: SphereGrid | Camera, directions: Float[Tensor, "*batch 3"]
) -> Int[Tensor, "*batch"]:
    """Index (*) into the flattened source of the value nearest to each direction (*, 3)."""
    if not isinstance(source, Camera):
        return source.nearest(directions)
    pixels, valid = source.project(directions)
    return nearest_pixel(source, torch.where(valid.unsqueeze(-1), pixels, 0.0))


class _GridImageLookup(nn.Module):
    """Bilinear interpolation in the image that a grid makes of its values."""

    def __init__(self, source: Any, pixels: Tensor, seen: Tensor, shares: Tensor | None) -> None:
        super().__init__()
        self.source = source
        height, width = source.image(pixels.new_zeros(1, *source.shape)).shape[-2:]
        edges = getattr(source, "image_edges", "border")
        self.lookup = image_lookup(pixels, seen, (height, width), shares, edges)

    def forward(self, values: Tensor) -> Tensor:
        result: Tensor = self.lookup(self.source.image(values))
        return result


class _DirectionLookup(PlacesInSinglePrecision):
    """``source.sample`` at directions (*g, n, s, 3): for grids that offer no tables."""

    directions: Tensor
    shares: Tensor

    def __init__(self, source: SphereGrid, directions: Tensor, shares: Tensor) -> None:
        super().__init__()
        self.source = source
        self.register_buffer("directions", directions, persistent=False)
        self.register_buffer("shares", shares, persistent=False)

    def forward(self, values: Tensor) -> Tensor:
        samples = self.source.sample(values, self.directions.flatten(-3, -2).to(values.dtype))
        samples = samples.unflatten(-1, self.shares.shape[-2:])
        return (samples * self.shares.to(samples.dtype).unsqueeze(-3)).sum(-1)


def _merged(ids: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """The same sums (*, m) with every id once: samples close together read the same values."""
    ids, order = ids.sort(-1)
    weights = weights.gather(-1, order)
    first = F.pad(ids.diff(dim=-1) != 0, (1, 0), value=True)
    slots = first.long().cumsum(-1) - 1
    count = int(slots.max()) + 1
    merged_ids = torch.zeros_like(ids).scatter_(-1, slots, ids)[..., :count]
    merged_weights = torch.zeros_like(weights).scatter_add_(-1, slots, weights)[..., :count]
    return merged_ids.contiguous(), merged_weights.contiguous()
