# SPDX-License-Identifier: Apache-2.0
"""The fastest way to read values of a grid or pixels of a camera at fixed directions."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from sphericalvision.cameras import Camera
from sphericalvision.cameras.remapping.lookup import image_edges, nearest_pixel
from sphericalvision.geometry.lookup import ImageLookup, Lookup
from sphericalvision.sphere.grids.base import SphereGrid

__all__ = ["make_lookup", "nearest_index"]


def make_lookup(
    source: SphereGrid | Camera, directions: Float[Tensor, " ..."], shares: Float[Tensor, " ..."]
) -> nn.Module:
    """A lookup of the source's interpolated values: values (*b, c, *source_shape) to (*b, c, n).

    Args:
        source: grid or camera.
        directions: of s samples for each of n targets (*g, n, s, 3), of any length.
        shares: of every sample in its target (*g, n, s); zero for samples that are not to be read.
    """
    seen = shares > 0
    averaged = shares if shares.shape[-1] > 1 else None
    if isinstance(source, Camera):
        pixels = source.project(directions).pixels
        return ImageLookup(pixels, seen, source.image_size, averaged, image_edges(source))
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
        self.lookup = ImageLookup(pixels, seen, (height, width), shares, edges)

    def forward(self, values: Tensor) -> Tensor:
        found: Tensor = self.lookup(self.source.image(values))
        return found


class _DirectionLookup(nn.Module):
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
