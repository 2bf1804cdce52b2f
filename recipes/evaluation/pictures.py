# SPDX-License-Identifier: Apache-2.0
"""Pictures of estimates and the truth, the same for every comparison."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from torch import Tensor

from sphericalvision.io.images import as_bytes
from sphericalvision.recipes.evaluation.methods import Scale
from sphericalvision.sweep import depth_from_index
from sphericalvision.viz import depth_to_color, error_to_color, sheet
from sphericalvision.viz.color import fade
from sphericalvision.viz.panorama import icosphere_to_panorama

Picture = npt.NDArray[np.uint8]

WORST = 10.0
"""Error in percent of N at the end of the scale of colours."""

FADED = 0.35
"""Fraction of the colour of what does not count."""


class DrawnFrame(NamedTuple):
    """A frame as it is drawn.

    Attributes:
        camera: uint8 ``(h, w, 3)``, the image of the first camera, as methods get it.
        view: uint8 ``(h, 2h, 3)``, what there is to see.
        truth: ``(V,)`` true index in the hypotheses of ``scale``, NaN where unknown.
        counts: ``(V,)`` where errors are taken; the rest is faded.
        estimates: name of a method -> index ``(V,)``, NaN where it says nothing.
        scale: hypotheses.
    """

    camera: Picture
    view: Picture
    truth: Tensor
    counts: Tensor
    estimates: Mapping[str, Tensor]
    scale: Scale

    def pictures(self) -> dict[str, Picture]:
        """Pictures by their titles: what there is to see, the truth, and of every method the depth and the error.

        Depths have the mean absolute error in percent of N in their titles. Errors are from 0 (dark) to ``WORST``
        percent of N (bright).
        """
        rows = len(self.view)
        pictures = {"first camera": self.camera, "view": self.view, "truth": self._depth(self.truth)}
        for name, index in self.estimates.items():
            error = self._error(index)
            valid = self.counts & ~error.isnan()
            mean = f"{float(error[valid].mean()):.2f}" if valid.any() else "-"
            pictures[f"{name}: MAE {mean}"] = self._faded(self._depth(index))
            drawn = error_to_color(icosphere_to_panorama(error.nan_to_num(WORST), rows), WORST)
            pictures[f"error of {name}"] = self._faded(drawn)
        return pictures

    def _error(self, index: Tensor) -> Tensor:
        return (index - self.truth).abs() * (100 / self.scale.num_hypotheses)

    def _depth(self, index: Tensor) -> Picture:
        valid = icosphere_to_panorama((~index.isnan()).float(), len(self.view)) > 0.5
        filled = icosphere_to_panorama(index.nan_to_num().clamp(min=0), len(self.view))
        depth = depth_from_index(filled, *self.scale).where(valid, math.nan)
        return depth_to_color(depth, self.scale.min_depth)

    def _faded(self, picture: Picture) -> Picture:
        counts = icosphere_to_panorama(self.counts.float(), len(self.view))
        return fade(picture, FADED + (1 - FADED) * counts)


def camera_picture(image: Tensor, rows: int) -> Picture:
    """uint8 ``(rows, w, 3)`` of an image ``(3, h, w)`` in [0, 1], at most twice as wide as high."""
    picture = as_bytes(image)
    width = min(2 * rows, round(rows * picture.shape[1] / picture.shape[0]))
    return cv2.resize(picture, (width, rows), interpolation=cv2.INTER_AREA)  # type: ignore[return-value]


def frames_sheet(frames: Mapping[str, DrawnFrame]) -> Picture:
    """Frames side by side, each below its name; uint8 RGB."""
    columns = [
        [(f"{name}, {title}", picture) for title, picture in frame.pictures().items()]
        for name, frame in frames.items()
    ]
    return sheet(dict(cell for row in zip(*columns, strict=True) for cell in row), columns=len(columns))
