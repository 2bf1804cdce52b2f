# SPDX-License-Identifier: Apache-2.0
"""Depth in colours that use their range and fade where little is known."""

from __future__ import annotations

import math
from typing import Any

import numpy.typing as npt

from sphericalvision.capture.depth import Depth, DepthImage
from sphericalvision.viz.color import near_end
from sphericalvision.viz.panorama import confidence_strength, depth_panorama

__all__ = ["depth_picture", "near_end_of"]

SURE = 0.3
"""Confidence from which depth counts for the scale."""


def near_end_of(depth: Depth) -> float:
    """Return the red end of pictures of a frame, in metres: about the nearest that was seen and that is sure.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.scenes import make_scene, render_rig
        >>> from sphericalvision.capture import Predictor
        >>> rig = ring_rig(4, image_size=(64, 64))
        >>> depth = Predictor(rig, method="semi_global", level=4, min_depth=0.1)(render_rig(make_scene("room", 1), rig))
        >>> near_end_of(depth)
        0.6
    """
    sure = depth.seen & (depth.confidence > SURE)
    return near_end(depth.depth.where(sure, math.nan), depth.min_depth)


def depth_picture(image: DepthImage, near: float) -> npt.NDArray[Any]:
    """Return depth in colours with a scale, greyer where it is less sure, grey where fewer than two cameras look.

    Args:
        image: ``(h, w)``, a panorama or a camera's.
        near: metres, the red end of the scale.

    Returns:
        uint8 ``(h + margins, w, 3)``.
    """
    return depth_panorama(image.depth, near, strength=confidence_strength(image.confidence, image.seen))
