# SPDX-License-Identifier: Apache-2.0
"""Means over the cells of a target: how many samples each takes, and in which smaller image of the source."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.models.equirectangular import EquirectangularCamera
from sphericalvision.geometry.lookup import ImageLookup

__all__ = ["PyramidLookup", "SampleGroup", "footprint", "level_size", "sample_groups"]

_SAMPLES = 4  # a side, of a footprint as wide as high, before it is looked up in a smaller image instead
_SLACK = 0.25  # samples may lie this much further apart than pixels, so that turning alone adds none


class SampleGroup(NamedTuple):
    """Target pixels that are averaged over equally many samples of one level of the source's pyramid."""

    level: int
    """The source image is halved so often."""
    members: Tensor
    """Flat indices of the target pixels (k,)."""
    offsets: Tensor
    """From the pixel's centre to its samples (s, 2), in target pixels."""


def footprint(
    pixels: Float[Tensor, "*batch h w 2"], valid: Bool[Tensor, "*batch h w"], source: Camera
) -> Float[Tensor, "h w 2"]:
    """Source pixels that one target pixel spans along u and along v, (h, w, 2); at least 1.

    Measured between neighbouring target pixels, the larger of the two sides, the largest of a batch. In a panorama a
    step along a row counts as long as it is on the sphere: near a pole a row holds more pixels than content.

    Args:
        pixels: (*b, h, w, 2), the source pixel that each target pixel shows.
        valid: (*b, h, w).
        source: the camera that took the image.
    """
    pixels = pixels.detach()
    spans = []
    for axis in (-1, -2):
        count = valid.shape[axis] - 1
        axis_of_pixels = axis - 1
        step = pixels.diff(dim=axis_of_pixels)
        if isinstance(source, EquirectangularCamera):
            step = _on_sphere(step, pixels.narrow(axis_of_pixels, 0, count)[..., 1], source)
        both = valid.narrow(axis, 0, count) & valid.narrow(axis, 1, count)
        length = torch.where(both, torch.linalg.vector_norm(step, dim=-1), 0.0)
        before, after = ((1, 0), (0, 1)) if axis == -1 else ((0, 0, 1, 0), (0, 0, 0, 1))
        span = torch.maximum(F.pad(length, before), F.pad(length, after))
        spans.append(span.reshape(-1, *span.shape[-2:]).amax(0))
    return torch.stack(spans, dim=-1).clamp(min=1)


def _on_sphere(step: Tensor, v: Tensor, source: EquirectangularCamera) -> Tensor:
    """Steps (*, 2) in a panorama the short way round, their share along the row by its length on the sphere."""
    height, width = source.image_size
    latitude = sum(source.latitudes) / 2 + (0.5 - (v + 0.5) / height) * source.vertical_field_of_view
    around = width * (2 * math.pi / (source.longitudes[1] - source.longitudes[0]))
    across = torch.remainder(step[..., 0] + around / 2, around) - around / 2
    return torch.stack((across * torch.cos(latitude), step[..., 1]), dim=-1)


def sample_groups(spans: Float[Tensor, "h w 2"], image_size: tuple[int, int]) -> list[SampleGroup]:
    """Target pixels grouped by the number of samples that their footprint ``spans`` (h, w, 2) asks for.

    Samples lie about one pixel apart. A footprint of more than 16 pixels is looked up in an image averaged over
    squares of 2, 4, 8, ... pixels, so a target pixel costs about 16 samples at most.
    """
    spans = spans.flatten(0, 1)
    deepest = max(0, math.floor(math.log2(min(image_size))))
    level = torch.log2(spans.prod(-1).sqrt() / (_SAMPLES + _SLACK)).ceil().clamp(0, deepest)
    counts = torch.ceil(spans / 2 ** level.unsqueeze(-1) - _SLACK).clamp(1, _SAMPLES**2)
    base = _SAMPLES**2 + 1
    kind = ((level * base + counts[:, 0]) * base + counts[:, 1]).long()
    groups = []
    for number in torch.unique(kind).tolist():
        depth, across, down = number // base**2, number // base % base, number % base
        u = (torch.arange(across, dtype=spans.dtype, device=spans.device) + 0.5) / across - 0.5
        v = (torch.arange(down, dtype=spans.dtype, device=spans.device) + 0.5) / down - 0.5
        offsets = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1).flatten(0, 1)
        groups.append(SampleGroup(depth, (kind == number).nonzero()[:, 0], offsets))
    return groups


def level_size(image_size: tuple[int, int], level: int) -> tuple[int, int]:
    """(height, width) of an image that was halved ``level`` times.

    Examples:
        >>> level_size((48, 65), 2)
        (12, 17)
    """
    height, width = image_size
    return (max(1, -(-height // 2**level)), max(1, -(-width // 2**level)))


class PyramidLookup(nn.Module):
    """Groups of targets, each looked up in an image that was halved as often as its footprint asks for.

    Args:
        lookups: of the groups, from the finest level to the coarsest.
        levels: of each lookup's image.
        members: flat indices of the targets of each group (k,).
    """

    order: Tensor

    def __init__(
        self, lookups: Sequence[ImageLookup], levels: Sequence[int], members: Sequence[Int[Tensor, " _"]]
    ) -> None:
        super().__init__()
        self.lookups = cast("Sequence[ImageLookup]", nn.ModuleList(lookups))
        self.levels = tuple(levels)
        self.register_buffer("order", torch.cat(list(members)).argsort(), persistent=False)

    def forward(self, images: Shaped[Tensor, "*images C h w"]) -> Shaped[Tensor, "*batch C P"]:
        """``images`` (*b, C, height, width) at the targets, (*b, C, P)."""
        full, level, found = tuple(images.shape[-2:]), 0, []
        small = images
        for lookup, wanted in zip(self.lookups, self.levels, strict=True):
            while level < wanted:
                level += 1
                flat = small.reshape(-1, 1, *small.shape[-2:])
                halved = F.interpolate(flat, size=level_size((full[0], full[1]), level), mode="area")
                small = halved.view(*small.shape[:-2], *halved.shape[-2:])
            found.append(lookup(small))
        return torch.cat(found, dim=-1).index_select(-1, self.order)
