# SPDX-License-Identifier: Apache-2.0
"""Look-ups on the icosphere that cost little more than the interpolation: everything else is in a prepared table."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from sphericalvision.cameras import Camera
from sphericalvision.cameras.sphere_images import SphereLookup

__all__ = ["FastLookup"]

#: The number of vertices of any icosphere is a multiple of six, and grid_sample works in parallel on a batch only.
PARTS = 6


class FastLookup(NamedTuple):
    """Turns an image ``(c, h, w)`` in [0, 1] into values ``(c, V)`` in [-1, 1], 0 where nothing is seen.

    The same as ``2 * lookup(image, 0.5) - 1``. Unseen directions fall outside of the image, where ``grid_sample`` finds
    0, and the scaling leaves them there.
    """

    lookup: SphereLookup
    grid: Tensor | None
    """``(6, 1, V / 6, 2)``; None where an image has edges that meet, and is looked up as its camera says."""

    @staticmethod
    def of(lookup: SphereLookup) -> FastLookup:
        """Prepare the table of a look-up."""
        pixels = lookup.shrunk_pixels()
        if type(lookup.camera).interpolate is not Camera.interpolate or pixels.shape[-2] % PARTS:
            return FastLookup(lookup, None)
        height, width = (-(-side // lookup.shrink) for side in lookup.camera.image_size)
        size = pixels.new_tensor([width, height])
        places = torch.minimum(pixels.clamp(min=0), size - 1)
        grid = torch.where(lookup.seen[:, None], (2 * places + 1) / size - 1, -3.0)
        return FastLookup(lookup, grid.view(PARTS, 1, -1, 2))

    def __call__(self, image: Tensor) -> Tensor:
        if self.grid is None:
            return self.lookup(image, 0.5) * 2 - 1
        parts = self.lookup.shrunk(image).expand(PARTS, -1, -1, -1)
        values = F.grid_sample(parts, self.grid.to(image), padding_mode="zeros", align_corners=False)
        values = values.squeeze(2).transpose(0, 1).flatten(1)
        return values.mul_(2).sub_(self.lookup.seen.to(values))
