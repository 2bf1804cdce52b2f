# SPDX-License-Identifier: Apache-2.0
"""Means over the cells of a target: how many samples each takes, and in which smaller image of the source.

The one engine of area averaging: ``remap`` asks it for pixels of a camera, ``resample`` for cells of any grid.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, cast

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.models.equirectangular import EquirectangularCamera
from sphericalvision.geometry.image_lookup import ImageLookup, image_lookup
from sphericalvision.geometry.lookup import read_entries
from sphericalvision.geometry.separable_lookup import SeparableLookup
from sphericalvision.kernels import Operator

# A side, of a footprint as wide as high, before it is looked up in a smaller image instead. In images of noise the
# error of 4 is up to four times as large, and calls take as long: with fewer samples more images have to be made small.
_SAMPLES = 8
_SLACK = 0.25  # samples may lie this much further apart than pixels, so that turning alone adds none
_CACHED = 2**18  # values of a channel that stay in a core's cache


class CellGroup(NamedTuple):
    """Cells of a target that are averaged over equally many samples of one level of the source's pyramid."""

    level: int
    """The source image is halved so often."""
    cells: Int[Tensor, " k"]
    """Flat indices of the cells."""
    samples: tuple[int, int]
    """How many along a cell's u and v; both are the same in cells that are no pixels."""


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
        valid_steps = valid.narrow(axis, 0, count) & valid.narrow(axis, 1, count)
        length = torch.where(valid_steps, torch.linalg.vector_norm(step, dim=-1), 0.0)
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


def cell_groups(spans: Float[Tensor, "n 2"], image_size: tuple[int, int] | None = None) -> list[CellGroup]:
    """Cells grouped by the number of samples that their footprint ``spans`` (n, 2), in source pixels, asks for.

    Samples lie about one pixel apart. A footprint of more than 64 pixels is looked up in an image averaged over
    squares of 2, 4, 8, ... pixels, so a cell costs about 64 samples at most. A source whose values are no image, which
    has no ``image_size``, is not made smaller; its values lie about equally dense, so all cells are one group.

    Examples:
        >>> groups = cell_groups(torch.tensor([[1.0, 3.0], [40.0, 40.0]]), (480, 640))
        >>> [(group.level, group.samples) for group in groups]
        [(0, (1, 3)), (3, (5, 5))]
    """
    if image_size is None:
        count = max(1, math.ceil(float(spans.max()) - _SLACK))
        return [CellGroup(0, torch.arange(len(spans), device=spans.device), (count, count))]
    deepest = max(0, math.floor(math.log2(min(image_size))))
    level = torch.log2(spans.prod(-1).sqrt() / (_SAMPLES + _SLACK)).ceil().clamp(0, deepest)
    counts = torch.ceil(spans / 2 ** level.unsqueeze(-1) - _SLACK).clamp(1, _SAMPLES**2)
    base = _SAMPLES**2 + 1
    kind = ((level * base + counts[:, 0]) * base + counts[:, 1]).long()
    groups = []
    for number in torch.unique(kind).tolist():
        samples = (number // base % base, number % base)
        groups.append(CellGroup(number // base**2, (kind == number).nonzero()[:, 0], samples))
    return groups


def pixel_samples(
    camera: Camera, cells: Int[Tensor, " k"], samples: tuple[int, int], dtype: torch.dtype
) -> Float[Tensor, "k s 2"]:
    """Positions (u, v) spread evenly over pixels of a camera's image, ``samples`` along u and along v.

    Args:
        camera: any.
        cells: flat indices of the pixels; the device of the answer.
        samples: along u and along v.
        dtype: of the answer.

    Examples:
        >>> pixel_samples(EquirectangularCamera((4, 8)), torch.tensor([9]), (2, 1), torch.float32).tolist()
        [[[0.75, 1.0], [1.25, 1.0]]]
    """
    u, v = ((torch.arange(n, dtype=dtype, device=cells.device) + 0.5) / n - 0.5 for n in samples)
    offsets = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1).flatten(0, 1)
    width = camera.image_size[1]
    centers = torch.stack((cells % width, torch.div(cells, width, rounding_mode="floor")), -1).to(dtype)
    return centers.unsqueeze(1) + offsets


def lookup_at_level(
    pixels: Float[Tensor, "*#batch k s 2"],
    seen: Bool[Tensor, "*#batch k s"],
    image_size: tuple[int, int],
    level: int,
    edges: str,
    shares: Float[Tensor, "*#batch k s"] | None = None,
) -> ImageLookup | SeparableLookup:
    """Means over ``pixels`` of the source's image, looked up in the image that was halved ``level`` times.

    Args:
        pixels: of k cells' samples, in the image as it is.
        seen: of the samples; the others count as zero.
        image_size: (height, width) of the image as it is.
        level: how often it is halved.
        edges: how it goes on beyond its edges, as of ``image_lookup``.
        shares: of each sample in its cell; all the same if not given.
    """
    small = _level_size(image_size, level)
    if level:
        scale = pixels.new_tensor([small[1] / image_size[1], small[0] / image_size[0]])
        pixels = (pixels + 0.5) * scale - 0.5
    return image_lookup(pixels, seen, small, shares, edges)


def _level_size(image_size: tuple[int, int], level: int) -> tuple[int, int]:
    """(height, width) of an image that was halved ``level`` times."""
    height, width = image_size
    return (-(-height // 2**level), -(-width // 2**level))


def as_floats(images: Shaped[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Return bytes as float32 in [0, 1], and other images as they are."""
    return images.float() / 255 if images.dtype == torch.uint8 else images


def _block_means(images: Shaped[Tensor, "*batch h w"], side: int) -> Float[Tensor, "*batch rows columns"]:
    """Return means over squares of pixels, those at the right and at the bottom over what remains; as ``as_floats``."""
    small = F.avg_pool2d(as_floats(images).reshape(-1, 1, *images.shape[-2:]), side, ceil_mode=True)
    return small.view(*images.shape[:-2], *small.shape[-2:])


def _block_means_by_rows(images: Tensor, side: int) -> Tensor:
    # What is converted stays in the cache until it is summed: first along rows, which are next to each other in memory.
    step = side * max(1, torch.get_num_threads() * _CACHED // (side * images.shape[-1]))
    dtype = images.dtype if images.is_floating_point() else torch.float32
    chunks = (
        as_floats(rows).to(torch.promote_types(dtype, torch.float32)) for rows in images.split(step, -2)
    )
    return torch.cat([_means_along(_means_along(rows, side, -2), side, -1) for rows in chunks], -2).to(dtype)


def _means_along(values: Tensor, side: int, dim: int) -> Tensor:
    """Means over so many neighbours, the last over what remains."""
    remaining = values.shape[dim] % side
    blocks, rest = values.split((values.shape[dim] - remaining, remaining), dim)
    means = blocks.unflatten(dim, (-1, side)).mean(dim)
    return torch.cat((means, rest.mean(dim, keepdim=True)), dim) if remaining else means


# On a CPU torch averages each result by itself.
block_means = Operator(_block_means, cpu=_block_means_by_rows)


class PyramidLookup(nn.Module):
    """Groups of cells, each looked up in an image that was halved as often as its footprint asks for.

    Args:
        groups: from the finest level to the coarsest; together all cells of the target.
        lookup: makes the lookup of a group, of values of its level.
    """

    order: Tensor

    def __init__(self, groups: Sequence[CellGroup], lookup: Callable[[CellGroup], nn.Module]) -> None:
        super().__init__()
        self.lookups = cast("Sequence[nn.Module]", nn.ModuleList(map(lookup, groups)))
        self.levels = tuple(group.level for group in groups)
        order = torch.cat([group.cells for group in groups]).argsort()
        self.register_buffer("order", order, persistent=False)

    def forward(self, images: Shaped[Tensor, "*images C h w"]) -> Shaped[Tensor, "*batch C P"]:
        """``images`` (*b, C, height, width) at the targets, (*b, C, P)."""
        image_size, level, results = tuple(images.shape[-2:]), 0, []
        small = images
        for lookup, wanted_level in zip(self.lookups, self.levels, strict=True):
            while level < wanted_level:
                level += 1
                flat = small.reshape(-1, 1, *small.shape[-2:])
                size = _level_size((image_size[0], image_size[1]), level)
                small = F.interpolate(flat, size=size, mode="area").view(*small.shape[:-2], *size)
            results.append(lookup(small))
        return read_entries(torch.cat(results, dim=-1), self.order)
