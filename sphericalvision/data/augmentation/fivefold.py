# SPDX-License-Identifier: Apache-2.0
"""Exact rotations of samples by multiples of 72 degrees about the vertical."""

from __future__ import annotations

import math
from typing import Any

import torch
from jaxtyping import Shaped
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.data.augmentation.sphere_rotation import fivefold_ids, yaw_angle, yaw_rotation

__all__ = ["RotateFivefold", "rotate_fivefold"]

ON_ICOSPHERE = ("images", "seen", "inverse_depth", "valid")
BY_NAME = ("fixed",)
ON_PANORAMA = ("panorama_inverse_depth", "panorama_valid")


def rotate_fivefold(values: Shaped[Tensor, "*values V"], steps: int) -> Shaped[Tensor, "*values V"]:
    """Turn what stands on an icosphere's vertices by ``steps`` x 72 degrees about the vertical.

    The icosahedron maps onto itself, chart to chart, so nothing is interpolated. Forward (+z) turns towards
    right (+x).

    Args:
        values: ``(*, V)`` in the structured vertex order (pole, five charts, pole).
        steps: any whole number.

    Raises:
        ArgumentError: the last dimension is not the vertex count of any level.

    Examples:
        >>> rotate_fivefold(torch.arange(12), 1)
        tensor([ 0,  9, 10,  1,  2,  3,  4,  5,  6,  7,  8, 11])
    """
    count = values.shape[-1]
    if count < 12 or (count - 2) % 10 or math.log(max(1, (count - 2) // 10), 4) % 1:
        raise ArgumentError(
            f"values: expected (*, 2 + 10 * 4**level) for some level, got {tuple(values.shape)}"
        )
    ids = fivefold_ids(count, torch.tensor([steps], device=values.device))
    return values.index_select(-1, ids)


class RotateFivefold:
    """Augmentation of a sample: the world, rig included, turned by a multiple of 72 degrees about the vertical.

    Nothing is interpolated: values on the icosphere (``images``, ``seen``, ``inverse_depth``, ``valid``, and all of
    ``fixed``) move from chart to chart, panoramas (``panorama_inverse_depth``, ``panorama_valid``) by whole columns.
    The cameras' own images (``fisheye``, ``fisheye_seen``) stay, since they turn with the world. Whichever of these a
    sample has, all networks see the same turns.

    Args:
        generator: source of the random choice; torch's own when not given.
        steps: a fixed multiple instead of a random one.

    Raises:
        ArgumentError: when called with a panorama whose width is no multiple of 5.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> turned = RotateFivefold(steps=1)({"panorama_valid": torch.arange(10).view(1, 10), "rig": ring_rig(2)})
        >>> turned["panorama_valid"]
        tensor([[8, 9, 0, 1, 2, 3, 4, 5, 6, 7]])
    """

    def __init__(self, generator: torch.Generator | None = None, steps: int | None = None) -> None:
        self.generator = generator
        self.steps = steps

    def __call__(self, sample: dict[str, Any]) -> dict[str, Any]:
        steps = self.steps
        if steps is None:
            steps = int(torch.randint(5, (), generator=self.generator))
        turned: dict[str, Any] = {
            key: rotate_fivefold(sample[key], steps) for key in ON_ICOSPHERE if key in sample
        }
        for key in BY_NAME:
            if key in sample:
                turned[key] = {name: rotate_fivefold(v, steps) for name, v in sample[key].items()}
        turned |= {key: _rolled(key, sample[key], steps) for key in ON_PANORAMA if key in sample}
        return {**sample, **turned, "rig": _turned(sample["rig"], steps)}

    def __repr__(self) -> str:
        return f"RotateFivefold(steps={self.steps})"


def _rolled(key: str, panorama: Tensor, steps: int) -> Tensor:
    width = panorama.shape[-1]
    if width % 5:
        raise ArgumentError(
            f"{key}: expected a width that is a multiple of 5, so that 72 degrees are whole columns, got {width}"
        )
    return panorama.roll(steps * (width // 5), -1)


def _turned(rig: CameraRig, steps: int) -> CameraRig:
    """The rig turned about the world's vertical through the origin."""
    turn = yaw_rotation(yaw_angle(torch.tensor(steps), 5))
    return rig.rotated(rotation=turn.to(rig.world_from_camera))
