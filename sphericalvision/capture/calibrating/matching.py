# SPDX-License-Identifier: Apache-2.0
"""The same things in the images of a rig's cameras, found by local features."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import check_single
from sphericalvision.cameras.models.pinhole import PinholeCamera
from sphericalvision.cameras.remapping.remap import Remap
from sphericalvision.cameras.remapping.views import rotation_from_yaw_pitch_roll
from sphericalvision.cameras.resolution import pixels_a_radian
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.capture.calibrating.align import RayMatches
from sphericalvision.core import ArgumentError

__all__ = ["RayMatcher"]

_VIEWS_DEG = (*((45.0 * i, 0.0, 0.0) for i in range(8)), (0.0, 90.0, 0.0), (0.0, -90.0, 0.0))
"""Yaw, pitch and roll of the views in which features are compared: around the horizon, up and down."""
_FIELD = math.radians(100)
_LARGEST = 1024
_BORDER = 4
"""Pixels at the edge of what a camera sees where a feature would be one of the edge."""
_DISTINCT = 0.8
"""How much nearer than the second best the best must be (Lowe's ratio)."""


class _Features(NamedTuple):
    rays: Tensor
    descriptors: np.ndarray


class RayMatcher:
    """Finds pairs of rays of a rig's cameras that see the same thing.

    A fisheye bends things too much for features to be compared across a rig. So all cameras are brought to the same
    pinhole views, ten around the rig: the view of one differs from that of another by parallax, and by what the poses
    are wrong by. SIFT features of the same view are compared, and kept if each is the other's best, clearly.

    Args:
        rig: a single rig; its poses may be off by some degrees.
        features: most features of a view.

    References:
        Lowe (2004), "Distinctive image features from scale-invariant keypoints".

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.scenes import make_scene, render_rig
        >>> rig = ring_rig(2, image_size=(128, 128))
        >>> matches = RayMatcher(rig)(render_rig(make_scene("floating", seed=5), rig))
        >>> len(matches.first) > 10, matches.first.unique().tolist(), matches.second.unique().tolist()
        (True, [0], [1])
    """

    def __init__(self, rig: CameraRig, features: int = 500) -> None:
        check_single(rig)
        self.rig = rig
        self.sift = cv2.SIFT_create(  # type: ignore[attr-defined]
            nfeatures=features, contrastThreshold=0.02
        )
        size = min(
            _LARGEST, round(2 * math.tan(_FIELD / 2) * max(map(pixels_a_radian, rig.cameras.values())))
        )
        self.view = PinholeCamera.from_field_of_view((size, size), _FIELD, dtype=torch.float64)
        angles = torch.tensor(_VIEWS_DEG, dtype=torch.float64).deg2rad()
        world_from_view = rotation_from_yaw_pitch_roll(angles)
        rotations = rig.world_from_camera[:, :3, :3].cpu().double()
        self.camera_from_view = rotations.mT[:, None] @ world_from_view
        self.lookups = [
            [self._lookup(name, view.mT) for view in views]
            for name, views in zip(rig.names, self.camera_from_view, strict=True)
        ]
        self.shown = [[_inner(lookup) for lookup in lookups] for lookups in self.lookups]

    def __call__(self, images: Mapping[str, Float[Tensor, "3 _ _"]]) -> RayMatches:
        """The pairs in one frame, camera name -> ``(3, h, w)`` in [0, 1].

        Raises:
            ArgumentError: a camera has no image.
            ShapeError: an image is not of its camera's size.
        """
        if missing := [name for name in self.rig.names if name not in images]:
            raise ArgumentError(f"images: expected one for each camera, got none of {', '.join(missing)}")
        found = [self._features(place, images[name]) for place, name in enumerate(self.rig.names)]
        parts = [
            RayMatches(torch.empty(0).long(), torch.empty(0).long(), torch.empty(0, 3), torch.empty(0, 3))
        ]
        for first in range(len(found)):
            for second in range(first + 1, len(found)):
                for one, other in zip(found[first], found[second], strict=True):
                    left, right = _mutual(one.descriptors, other.descriptors)
                    count = len(left)
                    one_place, other_place = (torch.full((count,), place) for place in (first, second))
                    parts.append(RayMatches(one_place, other_place, one.rays[left], other.rays[right]))
        return RayMatches.joined(parts)

    def _lookup(self, name: str, view_from_camera: Tensor) -> Remap:
        camera, mask = self.rig.cameras[name].to("cpu"), self.rig.masks.get(name)
        return Remap(camera, self.view, view_from_camera, mask=None if mask is None else mask.cpu())

    def _features(self, place: int, image: Tensor) -> list[_Features]:
        grey = image.detach().cpu().float().mean(0, keepdim=True)
        return [
            self._of_view(lookup(grey), shown, turn)
            for lookup, shown, turn in zip(
                self.lookups[place], self.shown[place], self.camera_from_view[place], strict=True
            )
        ]

    def _of_view(self, grey: Tensor, shown: np.ndarray, camera_from_view: Tensor) -> _Features:
        picture = grey[0].mul(255).round().clamp(0, 255).to(torch.uint8).numpy()
        points, descriptors = self.sift.detectAndCompute(picture, shown) if shown.any() else ((), None)
        if descriptors is None:
            return _Features(torch.empty(0, 3), np.empty((0, 128), np.float32))
        pixels = torch.tensor([point.pt for point in points], dtype=torch.float64)
        rays = self.view.unproject(pixels).directions @ camera_from_view.mT
        return _Features(rays.float(), descriptors)


def _inner(lookup: Remap) -> np.ndarray:
    """Where a view shows something, without its edge: uint8, 255 or 0."""
    shown = lookup.mask().cpu().numpy().astype(np.uint8) * 255
    return cv2.erode(shown, np.ones((2 * _BORDER + 1,) * 2, np.uint8))


def _mutual(one: np.ndarray, other: np.ndarray) -> tuple[list[int], list[int]]:
    """Places of descriptors that are each other's best, and distinct."""
    if min(len(one), len(other)) < 2:
        return [], []
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {match.queryIdx: match.trainIdx for (match,) in matcher.knnMatch(other, one, 1)}
    kept = [
        best
        for best, second in matcher.knnMatch(one, other, 2)
        if best.distance < _DISTINCT * second.distance and back[best.trainIdx] == best.queryIdx
    ]
    return [match.queryIdx for match in kept], [match.trainIdx for match in kept]
