# SPDX-License-Identifier: Apache-2.0
"""The tables behind ``remap`` and ``Remap``: what each mode looks up, and depth in its inverse."""

from __future__ import annotations

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.checks import check_rotation
from sphericalvision.cameras.remapping.footprint import footprint, sample_groups
from sphericalvision.cameras.remapping.lookup import (
    PyramidLookup,
    image_edges,
    level_size,
    nearest_pixel,
    source_pixels,
)
from sphericalvision.core import check_choice, check_tensor, check_type
from sphericalvision.geometry.lookup import ImageLookup, Lookup
from sphericalvision.geometry.masked_lookup import MaskedLookup

__all__ = ["REMAP_MODES", "remap_tables"]

REMAP_MODES = ("bilinear", "area", "bicubic", "nearest", "depth")


def remap_tables(
    source: Camera,
    target: Camera,
    rotation: Float[Tensor, "*turns 3 3"] | None,
    mode: str,
    fill: float,
    mask: Shaped[Tensor, "*masks h w"] | None,
    device: torch.device | str,
) -> MaskedLookup:
    """Where every target pixel is looked up; gradients reach rotation and intrinsics through it."""
    check_choice("mode", mode, REMAP_MODES)
    check_type("source", source, Camera)
    check_type("target", target, Camera)
    check_type("fill", fill, (int, float))
    if rotation is not None:
        check_rotation("rotation", rotation)
    if mask is not None:
        check_tensor("mask", mask, "(*b, h, w)")
    # In double precision, so that values, masks and modules agree about what lies on a border.
    dtype = torch.float32 if torch.device(device).type == "mps" else torch.float64
    size, edges = source.image_size, image_edges(source)
    centers = target.pixel_grid(dtype).to(device)
    pixels, valid = source_pixels(source, target, rotation, centers)
    flat_pixels, flat_valid = pixels.flatten(-3, -2).unsqueeze(-2), valid.flatten(-2).unsqueeze(-1)
    groups = sample_groups(footprint(pixels, valid, source), size) if mode == "area" else []
    whole = True
    if mode == "nearest":
        found = torch.where(valid.unsqueeze(-1), pixels, 0.0)
        lookup: Lookup | ImageLookup | PyramidLookup = Lookup(
            nearest_pixel(source, found).flatten(-2), dims=2
        )
    elif any(group.level or len(group.offsets) > 1 for group in groups):
        whole = False
        lookups = []
        for level, members, offsets in groups:
            samples = centers.flatten(0, 1)[members].unsqueeze(1) + offsets
            places, seen = source_pixels(source, target, rotation, samples)
            small = level_size(size, level)
            scale = places.new_tensor([small[1] / size[1], small[0] / size[0]])
            lookups.append(ImageLookup((places + 0.5) * scale - 0.5, seen, small, edges=edges))
        lookup = PyramidLookup(
            lookups, [group.level for group in groups], [group.members for group in groups]
        )
    else:
        lookup = ImageLookup(flat_pixels, flat_valid, size, edges=edges, cubic=mode == "bicubic")
    tables = _InverseLookup if mode == "depth" else MaskedLookup
    usable = None if mask is None else mask.to(device)
    # Where samples are averaged, what counts is whether enough of them see something.
    centers_valid = valid.flatten(-2) if whole else None
    return tables(lookup, size, target.image_size, mode, fill, centers_valid, usable, whole)


class _InverseLookup(MaskedLookup):
    """Depth along rays: its inverse is interpolated, and what is not positive is not known."""

    def forward(self, values: Tensor, mask: Tensor | None = None) -> Tensor:
        if not values.is_floating_point():
            return super().forward(values, mask)  # which says what is wrong
        known = (values > 0).all(-3)
        inverse = 1 / torch.where(values > 0, values, 1.0).to(
            torch.promote_types(values.dtype, torch.float32)
        )
        found, valid = self.means(inverse, known if mask is None else known & self._checked(mask))
        near = found > 0
        far = torch.full_like(found[..., :1, :], torch.inf)
        if valid is not None:
            far = torch.where(valid.unsqueeze(-2), far, self.fill)
        depth = torch.where(near, 1 / torch.where(near, found, 1.0), far)
        return depth.to(values.dtype).unflatten(-1, self.target_shape)
