# SPDX-License-Identifier: Apache-2.0
"""What ``remap`` and ``Remap`` share: lookups of every target pixel, masks, and the meaning of the modes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.remapping.footprint import footprint, sample_groups
from sphericalvision.cameras.remapping.lookup import Lookup, level_size, source_pixels
from sphericalvision.core import ArgumentError, ShapeError, check_choice

__all__ = ["REMAP_MODES", "RemapTables", "Remapped"]

REMAP_MODES = ("bilinear", "area", "bicubic", "nearest", "depth")

_TOUCHED = 1e-3  # the least share of usable pixels in what a value is made of


class Remapped(NamedTuple):
    """An image in the target camera and where it is known."""

    values: Tensor
    """(*b, c, h', w'), ``fill`` where not valid."""
    valid: Tensor
    """bool (*b, h', w'): both cameras look there, and usable pixels were found."""


class RemapTables(nn.Module):
    """Where every target pixel is looked up; gradients reach rotation and intrinsics through it."""

    order: Tensor | None
    usable: Tensor | None
    gain: Tensor | None
    filling: Tensor | None
    valid: Tensor

    def __init__(
        self,
        source: Camera,
        target: Camera,
        rotation: Tensor | None,
        mode: str,
        mask: Tensor | None,
        fill: float,
        dtype: torch.dtype,
        device: torch.device | str,
    ) -> None:
        super().__init__()
        check_choice("mode", mode, REMAP_MODES)
        if rotation is not None and (rotation.ndim < 2 or tuple(rotation.shape[-2:]) != (3, 3)):
            raise ShapeError(f"rotation: expected shape (*b, 3, 3), got {tuple(rotation.shape)}")
        self.mode, self.fill = mode, fill
        self.image_size, self.target_size = source.image_size, target.image_size
        centers = target.pixel_grid(dtype).to(device)
        pixels, valid = source_pixels(source, target, rotation, centers)
        order = None
        groups = sample_groups(footprint(pixels, valid, source), source.image_size) if mode == "area" else []
        if any(group.level or len(group.offsets) > 1 for group in groups):
            lookups = []
            for level, members, offsets in groups:
                samples = centers.flatten(0, 1)[members].unsqueeze(1) + offsets
                lookups.append(Lookup(*source_pixels(source, target, rotation, samples), source, level=level))
            order = torch.cat([group.members for group in groups]).argsort()
        else:
            interpolation = mode if mode in ("bicubic", "nearest") else "bilinear"
            lookups = [Lookup(pixels, valid, source, interpolation)]
        self.lookups = cast("Sequence[Lookup]", nn.ModuleList(lookups))
        self.register_buffer("order", order, persistent=False)
        usable = None if mask is None else self._checked_mask(mask.to(device))
        gain = None
        # An image of one row or column has no outside for grid_sample, so its share tells what is valid.
        if usable is not None or order is not None or 1 in self.image_size:
            whole = torch.ones(self.image_size, dtype=torch.bool, device=device)
            gain, valid = self._gain(whole if usable is None else usable, dtype)
        filling = self._filling(valid, dtype)
        for name, table in (("usable", usable), ("gain", gain), ("valid", valid), ("filling", filling)):
            self.register_buffer(name, table, persistent=False)

    def forward(self, image: Tensor, mask: Tensor | None = None) -> Remapped:
        """The image (*b, c, h, w) in the target camera; ``mask`` (*b, h, w) tells its usable pixels."""
        self._check_image(image)
        gain, valid, filling, usable = self.gain, self.valid, self.filling, self.usable
        dtype = torch.promote_types(image.dtype, torch.float32)
        if mask is not None:
            given = self._checked_mask(mask)
            usable = given if usable is None else given & usable
        if self.mode == "depth":
            known = (image > 0).all(-3)
            usable = known if usable is None else known & usable
        if usable is not None and usable is not self.usable:
            gain, valid = self._gain(usable, dtype)
            filling = self._filling(valid, dtype)
        if not image.is_floating_point():
            return self._labels(image, valid)
        values = image.to(dtype)
        if self.mode == "depth":
            values = 1 / torch.where((image > 0), values, 1.0)
        if usable is not None:
            values = torch.where(usable.unsqueeze(-3), values, 0.0)
        values = self._look_up(values)
        if gain is not None:
            values = values * gain
        if self.mode == "depth":
            finite = values > 0
            far = torch.where(valid.unsqueeze(-3), torch.inf, 0.0).to(dtype)
            values = torch.where(finite, 1 / torch.where(finite, values, 1.0), far)
        if filling is not None:
            values.add_(filling)
        return Remapped(values.to(image.dtype), valid.expand(*values.shape[:-3], *valid.shape[-2:]))

    def _look_up(self, image: Tensor) -> Tensor:
        """Means (*b, c, h', w') over the samples of every target pixel, of zero for samples that are not valid."""
        height, width = self.target_size
        batch = torch.broadcast_shapes(image.shape[:-3], self.lookups[0].grid.shape[:-3])
        small = image.expand(*batch, *image.shape[-3:]).reshape(-1, *image.shape[-3:])
        if self.order is None:
            return self.lookups[0](small, batch).reshape(*batch, -1, height, width)
        level, found = 0, []
        for lookup in self.lookups:
            while level < lookup.level:
                level += 1
                small = F.interpolate(small, size=level_size(self.image_size, level), mode="area")
            found.append(lookup(small, batch).mean(-1))
        return torch.cat(found, dim=-1)[..., self.order].reshape(*batch, -1, height, width)

    def _gain(self, usable: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """One over the share of usable pixels (*b, 1, h', w'), zero where too small, and where it is not."""
        share = self._look_up(usable.unsqueeze(-3).to(dtype))
        valid = share > _TOUCHED
        return torch.where(valid, 1 / torch.where(valid, share, 1.0), 0.0), valid.squeeze(-3)

    def _filling(self, valid: Tensor, dtype: torch.dtype) -> Tensor | None:
        """What to add to zeros where not valid, (*b, 1, h', w'): faster than a ``where`` over all channels."""
        return None if self.fill == 0 else torch.where(valid, 0.0, self.fill).to(dtype).unsqueeze(-3)

    def _labels(self, image: Tensor, valid: Tensor) -> Remapped:
        height, width = self.target_size
        index = self.lookups[0].index(self.image_size).flatten(-2).unsqueeze(-2)
        batch = torch.broadcast_shapes(image.shape[:-3], index.shape[:-2])
        pixels = image.expand(*batch, *image.shape[-3:]).flatten(-2)
        values = pixels.gather(-1, index.expand(*pixels.shape[:-1], -1)).unflatten(-1, (height, width))
        values = torch.where(valid.unsqueeze(-3), values, torch.full_like(values[..., :1, :1], self.fill))
        return Remapped(values, valid.expand(*values.shape[:-3], height, width))

    def _check_image(self, image: Tensor) -> None:
        height, width = self.image_size
        if image.ndim < 3 or tuple(image.shape[-2:]) != self.image_size:
            raise ShapeError(
                f"image: the source camera's images are {height} x {width} (height x width), got shape "
                f"{tuple(image.shape)}; resize the image or use the calibration of this image size"
            )
        if image.is_floating_point():
            return
        if self.mode != "nearest":
            raise ArgumentError(
                f"image: expected floating point values for mode {self.mode!r}, got {image.dtype}; convert it, or "
                "use mode 'nearest' for labels"
            )
        info = None if image.dtype == torch.bool else torch.iinfo(image.dtype)
        least, most = (0, 1) if info is None else (info.min, info.max)
        if not (least <= self.fill <= most and self.fill == int(self.fill)):
            raise ArgumentError(f"fill: expected a value that {image.dtype} can hold, got {self.fill}")

    def _checked_mask(self, mask: Tensor) -> Tensor:
        height, width = self.image_size
        if mask.ndim < 2 or tuple(mask.shape[-2:]) != self.image_size:
            raise ShapeError(
                f"mask: expected shape (*b, {height}, {width}) as the source camera's images, got {tuple(mask.shape)}"
            )
        if self.mode == "bicubic":
            raise ArgumentError(
                "mask: a bicubic kernel has negative weights; use 'bilinear' or 'area' with a mask"
            )
        return mask != 0
