# SPDX-License-Identifier: Apache-2.0
"""Panoramas and points of one frame, for the files that are made of it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

from sphericalvision.capture.points import SurfacePoints
from sphericalvision.capture.result import Depth, DepthImage, near_end_of
from sphericalvision.io.images import as_bytes
from sphericalvision.viz.panorama import confidence_strength, depth_panorama, rgb_panorama


class Panoramas:
    """Panoramas and points of one frame, each computed when something first needs it.

    Args:
        depth: of the frame.
        height: rows of the panoramas.
        near: metres, the red end of depth pictures; found in this frame when not given.
    """

    def __init__(self, depth: Depth, height: int, near: float | None = None) -> None:
        self.depth, self.height = depth, height
        self.near = near_end_of(depth) if near is None else near
        self._points: dict[tuple[float, float | None], SurfacePoints] = {}

    @cached_property
    def panorama(self) -> DepthImage:
        """Depth, confidence and what was seen."""
        return DepthImage(*(values.cpu() for values in self.depth.panorama(self.height)))

    @cached_property
    def colors(self) -> tuple[Tensor, Tensor]:
        """Colours ``(3, h, w)``, and where there are any."""
        return self._panorama_of(self.depth.images)

    @cached_property
    def stitched(self) -> npt.NDArray[Any]:
        """Colours ``(h, w, 3)``, uint8, as of cameras with one exposure and lenses without vignetting."""
        light = self.depth.compensations[0].light if self.depth.compensations else None
        if light is None:
            return as_bytes(self.colors[0])
        return as_bytes(self._panorama_of(light.corrected(self.depth.rig, self.depth.images))[0])

    @cached_property
    def depth_picture(self) -> npt.NDArray[Any]:
        """Depth in colours with a scale, greyer where it is less sure, grey where fewer than two cameras look."""
        image = self.panorama
        strength = confidence_strength(image.confidence, image.seen)
        return depth_panorama(image.depth, self.near, strength=strength)

    @property
    def colors_above_depth(self) -> npt.NDArray[Any]:
        """The panorama of the images above that of depth."""
        colors, depth = as_bytes(self.colors[0]), self.depth_picture
        side = (depth.shape[1] - colors.shape[1]) // 2  # the scale may be wider than a small panorama
        widths = ((0, 0), (side, depth.shape[1] - colors.shape[1] - side), (0, 0))
        return np.concatenate((np.pad(colors, widths, constant_values=255), depth))

    def points(self, min_confidence: float = 0.0, voxel: float | None = None) -> SurfacePoints:
        """The points of ``Depth.points``, as seen from the rig's origin, computed once for all files that have them."""
        key = min_confidence, voxel
        if key not in self._points:
            self._points[key] = self.depth.points(min_confidence, voxel=voxel)
        return self._points[key]

    def _panorama_of(self, images: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        on_cpu = {name: image.cpu() for name, image in images.items()}
        return rgb_panorama(self.depth.rig.to("cpu"), on_cpu, self.height, self.panorama.depth)
