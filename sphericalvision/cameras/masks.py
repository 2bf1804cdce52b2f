# SPDX-License-Identifier: Apache-2.0
"""Masks of a rig's cameras: which pixels of an image are usable, interpolated, resized, or in a batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras.base import Camera


def is_usable(
    camera: Camera, mask: Bool[Tensor, "*masks h w"], pixels: Float[Tensor, "*batch P 2"]
) -> Bool[Tensor, "*batch P"]:
    """Whether interpolation at pixels (*b, P, 2) takes usable pixels of the mask (*b, h, w) only, (*b, P)."""
    weight = camera.interpolate(mask.to(pixels).unsqueeze(-3), pixels).squeeze(-2)
    return weight > 0.999  # one, but for rounding


def resized_mask(
    mask: Bool[Tensor, "*batch h w"], image_size: tuple[int, int]
) -> Bool[Tensor, "*batch h_new w_new"]:
    """Whether all pixels (*b, h, w) under each pixel of another size are True."""
    for dim, new in ((-2, image_size[0]), (-1, image_size[1])):
        old = mask.shape[dim]
        step = torch.arange(new, device=mask.device)
        # Where the pixel begins and ends
        first, last = step * old // new, ((step + 1) * old + new - 1) // new
        bad = torch.nn.functional.pad((~mask).movedim(dim, -1).long().cumsum(-1), (1, 0))
        mask = (bad[..., last] == bad[..., first]).movedim(-1, dim)
    return mask


def stack_masks(cameras: Mapping[str, Camera], rigs: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Masks of rigs by name, shared where all have the same and stacked elsewhere; no mask means all is usable."""
    stacked = {}
    for name, camera in cameras.items():
        masks = [own.get(name) for own in rigs]
        present = [mask for mask in masks if mask is not None]
        if not present:
            continue
        if len(present) == len(masks) and all(
            mask is present[0] or torch.equal(mask, present[0]) for mask in present
        ):
            stacked[name] = present[0]
        else:
            usable = torch.ones(camera.image_size, dtype=torch.bool, device=present[0].device)
            stacked[name] = torch.stack([usable if mask is None else mask for mask in masks])
    return stacked
