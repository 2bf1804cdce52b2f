# SPDX-License-Identifier: Apache-2.0
"""Ways to read a source at fixed directions, each with the tables it needs.

A lookup maps values ``(*b, c, *source_shape)`` to ``(*b, c, n)``: a weighted mean over s samples for each of n targets.
Weights that sum to less than one mean that a part of a target is not seen.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sphericalvision.cameras import Camera, EquirectangularCamera
from sphericalvision.geometry import wrap_panorama
from sphericalvision.sphere.grids.base import SphereGrid
from sphericalvision.sphere.grids.values import sum_of_taps

__all__ = ["IndexLookup", "make_lookup", "nearest_index"]


class IndexLookup(nn.Module):
    """One value of the source for each target, of any dtype: ``index`` (*g, n) into the flattened source."""

    index: Tensor

    def __init__(self, index: Tensor, dims: int) -> None:
        super().__init__()
        self.dims = dims
        self.register_buffer("index", index, persistent=False)

    def forward(self, values: Tensor) -> Tensor:
        values = values.flatten(-self.dims)
        if self.index.ndim == 1:
            return values.index_select(-1, self.index)
        batch = torch.broadcast_shapes(values.shape[:-2], self.index.shape[:-1])
        return values.expand(*batch, *values.shape[-2:]).gather(
            -1, self.index.unsqueeze(-2).expand(*batch, values.shape[-2], -1)
        )


class TapLookup(nn.Module):
    """Sums over few values of the source: ``ids`` and ``weights`` (*g, n, m)."""

    ids: Tensor
    weights: Tensor

    def __init__(self, ids: Tensor, weights: Tensor, dims: int) -> None:
        super().__init__()
        self.dims = dims
        self.register_buffer("ids", ids, persistent=False)
        self.register_buffer("weights", weights, persistent=False)

    def forward(self, values: Tensor) -> Tensor:
        return sum_of_taps(values.flatten(-self.dims), self.ids, self.weights)


class ImageLookup(nn.Module):
    """Bilinear interpolation in an image made of the source, at pixels (*g, n, s, 2) with shares (*g, n, s)."""

    grid: Tensor
    shares: Tensor | None

    def __init__(self, source: SphereGrid | Camera, pixels: Tensor, shares: Tensor | None) -> None:
        super().__init__()
        self.source = source
        shape = source.image_size if isinstance(source, Camera) else source.shape
        image = self.image(pixels.new_zeros(1, *shape))
        size = pixels.new_tensor([image.shape[-1], image.shape[-2]])
        # grid_sample(align_corners=False) puts the centre of pixel i at (2 i + 1) / size - 1.
        self.register_buffer("grid", (2 * pixels + 1) / size - 1, persistent=False)
        self.register_buffer("shares", shares, persistent=False)

    def image(self, values: Tensor) -> Tensor:
        if isinstance(self.source, EquirectangularCamera):
            return wrap_panorama(values, poles=self.source.vertical_field_of_view > torch.pi - 1e-6)
        return values if isinstance(self.source, Camera) else self.source.image(values)  # type: ignore[attr-defined]

    def forward(self, values: Tensor) -> Tensor:
        image = self.image(values)
        grid = self.grid.to(image.dtype)
        if grid.ndim == 3:  # one for all of the batch: as more channels of one image it is read only once
            batch, flat = image.shape[:-2], image.reshape(1, -1, *image.shape[-2:])
            found = F.grid_sample(flat, grid.unsqueeze(0), padding_mode="border", align_corners=False)
            found = found.reshape(*batch, *found.shape[-2:])
        else:
            batch = torch.broadcast_shapes(image.shape[:-3], grid.shape[:-3])
            grid = grid.expand(*batch, *grid.shape[-3:]).reshape(-1, *grid.shape[-3:])
            flat = image.expand(*batch, *image.shape[-3:]).reshape(-1, *image.shape[-3:])
            found = F.grid_sample(flat, grid, padding_mode="border", align_corners=False)
            found = found.reshape(*batch, *found.shape[1:])
        if self.shares is None:
            return found.squeeze(-1)
        return (found * self.shares.to(found.dtype).unsqueeze(-3)).sum(-1)


class DirectionLookup(nn.Module):
    """``source.sample`` at directions (*g, n, s, 3): for grids that offer no tables."""

    directions: Tensor
    shares: Tensor

    def __init__(self, source: SphereGrid, directions: Tensor, shares: Tensor) -> None:
        super().__init__()
        self.source = source
        self.register_buffer("directions", directions, persistent=False)
        self.register_buffer("shares", shares, persistent=False)

    def forward(self, values: Tensor) -> Tensor:
        found = self.source.sample(values, self.directions.flatten(-3, -2).to(values.dtype))
        found = found.unflatten(-1, self.shares.shape[-2:])
        return (found * self.shares.to(found.dtype).unsqueeze(-3)).sum(-1)


def make_lookup(source: SphereGrid | Camera, directions: Tensor, shares: Tensor, exact: bool) -> nn.Module:
    """The fastest lookup of the source's interpolated values at directions (*g, n, s, 3).

    Args:
        source: grid or camera.
        directions: of any length.
        shares: of every sample (*g, n, s); zero for samples that are not to be read.
        exact: whether all shares are one, with a single sample for each target.
    """
    if isinstance(source, Camera):
        pixels = source.project(directions).pixels
        pixels = torch.where((shares > 0).unsqueeze(-1), pixels, 0.0)
        if isinstance(source, EquirectangularCamera):
            u, v = pixels.unbind(-1)
            pixels = torch.stack((torch.remainder(u + 0.5, source.image_size[1]) + 0.5, v + 1), -1)
        return ImageLookup(source, pixels, None if exact else shares)
    if hasattr(source, "image_pixels"):
        return ImageLookup(source, source.image_pixels(directions), None if exact else shares)
    taps = getattr(source, "taps", None) or getattr(source, "locate", None)
    if taps is None:
        return DirectionLookup(source, directions, shares)
    ids, weights = taps(directions)
    ids, weights = ids.flatten(-2), (weights * shares.unsqueeze(-1)).flatten(-2)
    if directions.shape[-2] > 1 and not weights.requires_grad:
        ids, weights = _merged(ids, weights)
    return TapLookup(ids, weights, len(source.shape))


def nearest_index(source: SphereGrid | Camera, directions: Tensor) -> Tensor:
    """Index (*) into the flattened source of the value nearest to each direction (*, 3)."""
    if not isinstance(source, Camera):
        return source.nearest(directions)
    height, width = source.image_size
    pixels, valid = source.project(directions)
    column, row = torch.where(valid.unsqueeze(-1), pixels + 0.5, 0.0).floor().long().unbind(-1)
    around = isinstance(source, EquirectangularCamera)
    column = column % width if around else column.clamp(0, width - 1)
    return row.clamp(0, height - 1) * width + column


def _merged(ids: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """The same sums (*, m) with every id once: samples close together read the same values."""
    ids, order = ids.sort(-1)
    weights = weights.gather(-1, order)
    first = F.pad(ids.diff(dim=-1) != 0, (1, 0), value=True)
    place = first.long().cumsum(-1) - 1
    count = int(place.max()) + 1
    merged_ids = torch.zeros_like(ids).scatter_(-1, place, ids)[..., :count]
    merged_weights = torch.zeros_like(weights).scatter_add_(-1, place, weights)[..., :count]
    return merged_ids.contiguous(), merged_weights.contiguous()
