# SPDX-License-Identifier: Apache-2.0
"""Pictures of estimates and the truth, the same for every comparison."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from torch import Tensor

from sphericalvision.recipes.evaluation.methods import Scale
from sphericalvision.sweep import depth_from_index
from sphericalvision.viz import depth_to_color, error_to_color
from sphericalvision.viz.color import fade
from sphericalvision.viz.panorama import icosphere_to_panorama

__all__ = ["WORST", "DrawnFrame", "color_picture"]

Picture = npt.NDArray[np.uint8]

WORST = 10.0
"""Error in percent of N at the end of the scale of colours."""

SHOWN = 0.35
"""How much colour is left of what does not count."""


class DrawnFrame(NamedTuple):
    """A frame as it is drawn.

    Attributes:
        view: uint8 ``(h, 2h, 3)``, what there is to see.
        truth: ``(V,)`` true index in the hypotheses of ``scale``, NaN where unknown.
        counts: ``(V,)`` where errors are taken; the rest is faded.
        estimates: name of a method -> index ``(V,)``, NaN where it says nothing.
        scale: hypotheses.
    """

    view: Picture
    truth: Tensor
    counts: Tensor
    estimates: Mapping[str, Tensor]
    scale: Scale

    def depths(self) -> dict[str, Picture]:
        """The view, the truth and every estimate with its mean absolute error in percent of N, by their titles."""
        pictures = {"view": self.view, "truth": self._depth(self.truth)}
        for name, index in self.estimates.items():
            valid = self.counts & ~self._error(index).isnan()
            mean = f"{float(self._error(index)[valid].mean()):.2f}" if valid.any() else "-"
            pictures[f"{name}: MAE {mean}"] = self._faded(self._depth(index))
        return pictures

    def errors(self) -> dict[str, Picture]:
        """The error of every estimate by its title, from 0 (dark) to ``WORST`` percent of N (bright)."""
        rows = len(self.view)
        return {
            f"error of {name}": self._faded(
                error_to_color(icosphere_to_panorama(self._error(index).nan_to_num(WORST), rows), WORST)
            )
            for name, index in self.estimates.items()
        }

    def _error(self, index: Tensor) -> Tensor:
        return (index - self.truth).abs() * (100 / self.scale.num_hypotheses)

    def _depth(self, index: Tensor) -> Picture:
        valid = icosphere_to_panorama((~index.isnan()).float(), len(self.view)) > 0.5
        filled = icosphere_to_panorama(index.nan_to_num().clamp(min=0), len(self.view))
        depth = depth_from_index(filled, *self.scale).where(valid, math.nan)
        return depth_to_color(depth, self.scale.min_depth)

    def _faded(self, picture: Picture) -> Picture:
        counts = icosphere_to_panorama(self.counts.float(), len(self.view))
        return fade(picture, SHOWN + (1 - SHOWN) * counts)


def color_picture(image: Tensor) -> Picture:
    """uint8 ``(h, w, 3)`` of an image ``(3, h, w)`` in [0, 1]."""
    return (image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()  # type: ignore[no-any-return]
