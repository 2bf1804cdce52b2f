# SPDX-License-Identifier: Apache-2.0
"""Exact rotations of samples by multiples of 72 degrees about the vertical."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Shaped
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.data.augmentation.sphere_rotation import yaw_angle, yaw_on_sphere, yaw_rotation
from sphericalvision.icosphere import Icosphere
from sphericalvision.icosphere.topology import level_from_num_vertices

__all__ = ["RotateFivefold", "moved_on_icosphere", "rotate_fivefold"]

ON_ICOSPHERE = ("images", "seen", "inverse_depth", "valid")
BY_NAME = ("fixed",)
ON_PANORAMA = ("panorama_inverse_depth", "panorama_valid")


def rotate_fivefold(values: Shaped[Tensor, "*values V"], steps: int) -> Shaped[Tensor, "*values V"]:
    """Turn what stands on an icosphere's vertices ``(*, V)`` by ``steps`` x 72 degrees: see ``yaw_on_sphere``.

    Raises:
        ShapeError: the last dimension is not the vertex count of any level.

    Examples:
        >>> rotate_fivefold(torch.arange(12), 1)
        tensor([ 0,  9, 10,  1,  2,  3,  4,  5,  6,  7,  8, 11])
    """
    return yaw_on_sphere(values, Icosphere(level_from_num_vertices(values.shape[-1])), steps, "labels")


def moved_on_icosphere(sample: dict[str, Any], move: Callable[[Tensor], Tensor]) -> dict[str, Any]:
    """Return the entries of a sample that lie on an icosphere, of any level, after ``move``."""
    moved: dict[str, Any] = {key: move(sample[key]) for key in ON_ICOSPHERE if key in sample}
    for key in BY_NAME:
        if key in sample:
            moved[key] = {name: move(values) for name, values in sample[key].items()}
    return moved


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
        turned = moved_on_icosphere(sample, lambda values: rotate_fivefold(values, steps))
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
