# SPDX-License-Identifier: Apache-2.0
"""A rig whose cameras are turned by a little from what its calibration says, corrected by the depth of some frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.resolution import pixels_a_radian
from sphericalvision.capture import align_rig_direct
from sphericalvision.capture.calibrating.turns import turned
from sphericalvision.capture.depth import Depth
from sphericalvision.capture.preparation.compensation import compensated
from sphericalvision.geometry.transforms import axis_angle_from_transform, invert_transform
from sphericalvision.icosphere import icosphere_vertices

__all__ = ["RigTurns", "turned_rig"]

LEVEL = 6
"""Icosphere level of the directions that are compared."""
STEPS = ((math.radians(0.9), 1.0, 4), (math.radians(0.9), 0.6, 3), (math.radians(0.45), 0.6, 3))
"""Pixel in radians, blur in pixels and iterations, one after the other."""
APART = 2.0
"""Times that turns must exceed the difference between those found from one half of all directions and the other."""
LEAST, LEAST_OF_TWO = 0.14, 0.45
"""Pixels, at least of the first step, root mean square of turns. Right calibrations are found to be off by up to 0.1
in a single frame; two cameras by more, as no third one contradicts."""
MOST = math.radians(3)
"""A camera that is found to be turned further was not found."""


class RigTurns(NamedTuple):
    """What a rig's cameras were turned by."""

    rig: CameraRig
    """With the cameras turned."""
    turns: Tensor
    """``(n, 3)`` rotation vectors in the world, radians."""
    agreement: tuple[float, float]
    """0 to 1: how well images agreed before and after."""

    def described(self) -> str:
        """Return what was turned and what it brought."""
        angles = zip(self.rig.names, self.turns.norm(dim=-1).tolist(), strict=True)
        which = ", ".join(f"{name} by {math.degrees(angle):.2f}°" for name, angle in angles)
        before, after = self.agreement
        return f"turns {which}: images agree better, {after:.3f} in place of {before:.3f} of 1"


def turned_rig(depths: Sequence[Depth]) -> RigTurns | None:
    """Return the rig with its cameras turned so that images agree at about the depth that was estimated.

    Args:
        depths: one frame or several of one rig, estimated with the rig as it is.

    Returns:
        None where the calibration is right, as far as images can tell, or where they tell nothing.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.scenes import make_scene, render_rig
        >>> from sphericalvision.capture import Predictor
        >>> rig = ring_rig(3, image_size=(64, 64))
        >>> predictor = Predictor(rig, method="semi_global", level=4, min_depth=0.55)
        >>> turned_rig([predictor(render_rig(make_scene("floating", seed=1), rig))]) is None
        True
    """
    rig = depths[0].rig
    directions = icosphere_vertices(LEVEL, torch.float32, rig.world_from_camera.device)
    images = [compensated(rig, depth.images) for depth in depths]
    stacked = {name: torch.stack([image[name] for image in images]) for name in rig.names}
    estimates = [_along(depth, directions) for depth in depths]
    inverse_depth, weights = (torch.stack(values) for values in zip(*estimates, strict=True))
    halves = [
        _found(rig, stacked, directions[part], inverse_depth[:, part], weights[:, part])
        for part in (slice(0, None, 2), slice(1, None, 2))
    ]
    turns = torch.stack([axis_angle for axis_angle, _ in halves])
    mean, apart = turns.mean(0), turns[0] - turns[1]
    size = _typical(mean)
    pixel = max(STEPS[0][0], *(1 / pixels_a_radian(camera) for camera in rig.cameras.values()))
    if (
        size < pixel * (LEAST if len(rig) > 2 else LEAST_OF_TWO)
        or size < APART * _typical(apart)
        or float(mean.norm(dim=-1).max()) > MOST
    ):
        return None
    before, after = (sum(found[part] for _, found in halves) / 2 for part in (0, 1))
    return RigTurns(turned(rig, mean), mean, (before, after))


def _found(
    rig: CameraRig, images: dict[str, Tensor], directions: Tensor, inverse_depth: Tensor, weights: Tensor
) -> tuple[Tensor, tuple[float, float]]:
    """Turns ``(n, 3)`` from coarse to fine, and how well the finest images agreed before and after."""
    better = rig
    for pixel, blur, iterations in STEPS:
        found = align_rig_direct(
            better, images, directions, inverse_depth, weights, pixel=pixel, blur=blur, iterations=iterations
        )
        better = found.rig
        if blur == STEPS[0][1]:
            agreement = found.agreement
    moved = better.world_from_camera.double() @ invert_transform(rig.world_from_camera.double())
    return axis_angle_from_transform(moved)[0], agreement


def _typical(turns: Tensor) -> float:
    """Root mean square of turns ``(n, 3)``."""
    return float(turns.square().sum(-1).mean().sqrt())


def _along(depth: Depth, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse depth and how much it is to be trusted, ``(V,)`` each."""
    index, reached = depth.network.index_at(depth.index[None], directions)
    trust, _ = depth.network.index_at((depth.confidence * depth.seen)[None], directions)
    steps = depth.network.num_hypotheses - 1
    return index[0] / (steps * depth.min_depth), (trust[0] * reached).clamp(0, 1)
