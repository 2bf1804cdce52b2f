# SPDX-License-Identifier: Apache-2.0
"""Where the pixels of one camera lie in another, and means over what a pixel covers there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.model_alone import lifted
from sphericalvision.cameras.models.equirectangular import EquirectangularCamera
from sphericalvision.core import full_precision
from sphericalvision.geometry.directions import broadcast_shapes
from sphericalvision.geometry.lookup import ImageLookup

__all__ = ["PyramidLookup", "image_edges", "level_size", "nearest_pixel", "source_pixels"]


@full_precision
def source_pixels(
    source: Camera,
    target: Camera,
    rotation: Float[Tensor, "*turns 3 3"] | None,
    positions: Float[Tensor, "*positions 2"],
) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
    """Pixels (*b, *, 2) of the source that show what the target shows at ``positions`` (*, 2), and validity (*b, *).

    Args:
        source: of any batch shape; batch shapes of both cameras and the rotation broadcast to *b.
        target: the camera whose pixels ``positions`` are.
        rotation: (*b, 3, 3), target_from_source.
        positions: (u, v); dtype and device of the answer.
    """
    turns = () if rotation is None else rotation.shape[:-2]
    batch = broadcast_shapes(source.batch_shape, target.batch_shape, turns)
    directions, seen = lifted(target, batch).unproject(positions.expand(*batch, *positions.shape))
    if rotation is not None:
        # target_from_source turns the other way: its transpose acts on column vectors, itself on rows.
        turn = rotation.to(directions).expand(*batch, 3, 3).reshape(-1, 3, 3)
        directions = (directions.reshape(len(turn), -1, 3) @ turn).reshape(directions.shape)
    pixels, visible = lifted(source, batch).project(directions)
    return pixels, seen & visible


def image_edges(camera: Camera) -> str:
    """How a camera's images go on beyond their edges, as ``ImageLookup`` calls it.

    Examples:
        >>> image_edges(EquirectangularCamera((4, 8)))
        'sphere'
    """
    return camera.edges if isinstance(camera, EquirectangularCamera) else "border"


def nearest_pixel(camera: Camera, pixels: Float[Tensor, "*batch 2"]) -> Int[Tensor, "*batch"]:
    """Index (*) into the flattened image of the pixel whose centre is nearest to ``pixels`` (*, 2).

    Examples:
        >>> nearest_pixel(EquirectangularCamera((4, 8)), torch.tensor([[7.6, 1.2], [2.0, -0.5]])).tolist()
        [8, 2]
    """
    height, width = camera.image_size
    column, row = (pixels.detach() + 0.5).floor().long().unbind(-1)
    column = column.clamp(0, width - 1) if image_edges(camera) == "border" else column % width
    return row.clamp(0, height - 1) * width + column


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
