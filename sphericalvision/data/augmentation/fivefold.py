# SPDX-License-Identifier: Apache-2.0
"""What maps an icosphere onto itself, exactly: turns of samples by multiples of 72 degrees, and their mirror image."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Shaped
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.data.augmentation.sphere_rotation import yaw_angle, yaw_rotation
from sphericalvision.icosphere import Icosphere
from sphericalvision.icosphere.topology import level_from_num_vertices

ON_ICOSPHERE = ("images", "seen", "inverse_depth", "valid", "clues")
ON_PANORAMA = ("panorama_inverse_depth", "panorama_valid")


def rotate_fivefold(values: Shaped[Tensor, "*values V"], steps: int) -> Shaped[Tensor, "*values V"]:
    """Turn what stands on an icosphere's vertices ``(*, V)`` by ``steps`` x 72 degrees, as ``yaw_on_sphere`` does.

    Charts follow each other in memory, so they move as wholes; the poles stay.

    Examples:
        >>> rotate_fivefold(torch.arange(12), 1)
        tensor([ 0,  9, 10,  1,  2,  3,  4,  5,  6,  7,  8, 11])
    """
    level_from_num_vertices(values.shape[-1])  # raises if there is none
    pole, charts, other_pole = values.tensor_split((1, -1), -1)
    return torch.cat((pole, charts.roll(steps * (charts.shape[-1] // 5), -1), other_pole), -1)


def moved_on_icosphere(sample: dict[str, Any], move: Callable[[Tensor], Tensor]) -> dict[str, Any]:
    """Return the entries of a sample that lie on an icosphere, of any level, after ``move``; a dict's values each."""
    return {
        key: {name: move(values) for name, values in sample[key].items()}
        if isinstance(sample[key], Mapping)
        else move(sample[key])
        for key in ON_ICOSPHERE
        if key in sample
    }


class RotateFivefold:
    """Augmentation of a sample: the world, rig included, turned by a multiple of 72 degrees about the vertical.

    Nothing is interpolated: values on the icosphere (``images``, ``seen``, ``inverse_depth``, ``valid``) move from
    chart to chart, panoramas (``panorama_inverse_depth``, ``panorama_valid``) by whole columns. The cameras' own images
    (``fisheye``, ``fisheye_seen``) stay, since they turn with the world. Whichever of these a sample has, all networks
    see the same turns.

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
        rotation = yaw_rotation(yaw_angle(torch.tensor(steps), 5)).to(sample["rig"].world_from_camera)
        return {**sample, **turned, "rig": sample["rig"].rotated(rotation=rotation)}

    def __repr__(self) -> str:
        return f"RotateFivefold(steps={self.steps})"


def _rolled(key: str, panorama: Tensor, steps: int) -> Tensor:
    width = panorama.shape[-1]
    if width % 5:
        raise ArgumentError(
            f"{key}: expected a width that is a multiple of 5, so that 72 degrees are whole columns, got {width}"
        )
    return panorama.roll(steps * (width // 5), -1)


class Mirror:
    """Augmentation of a sample on the icosphere: left and right of the world exchanged, rig included.

    The icosphere maps onto itself, so nothing is interpolated: ``images``, ``seen``, ``inverse_depth`` and ``valid``
    move to where their mirror image is. Cameras keep their models, so lenses must be symmetrical, as those of
    ``random_rig`` are; images of the cameras themselves and masks would have to be flipped, and are refused.

    Args:
        share: how often a sample is mirrored, 0 to 1.
        generator: source of the random choice; torch's own when not given.

    Raises:
        ArgumentError: when called with a sample that holds images of the cameras, a panorama or masks.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> sample = Mirror()({"valid": torch.arange(12), "rig": ring_rig(4)})
        >>> sample["valid"]
        tensor([ 0,  1,  4,  9,  2,  7, 10,  5,  8,  3,  6, 11])
        >>> sample["rig"].positions[1]  # the camera on the right is on the left
        tensor([-0.2000,  0.0000,  0.0000])
    """

    def __init__(self, share: float = 1.0, generator: torch.Generator | None = None) -> None:
        self.share = share
        self.generator = generator

    def __call__(self, sample: dict[str, Any]) -> dict[str, Any]:
        rig: CameraRig = sample["rig"]
        others = [key for key in sample if key.startswith(("fisheye", "panorama"))]
        if others or rig.masks:
            raise ArgumentError(
                f"Mirror: expected what lies on the icosphere alone, got {', '.join(others) or 'masks'}, too"
            )
        if torch.rand((), generator=self.generator) >= self.share:
            return sample
        moved = moved_on_icosphere(sample, _moved)
        return {**sample, **moved, "rig": _mirrored(rig)}

    def __repr__(self) -> str:
        return f"Mirror(share={self.share})"


def _moved(values: Tensor) -> Tensor:
    ids = mirror_ids(level_from_num_vertices(values.shape[-1])).to(values.device)
    return values.gather(-1, ids.expand_as(values))  # of bytes in an eighth of index_select's time


@lru_cache
def mirror_ids(level: int) -> Tensor:
    """Return at which vertex ``(V,)`` each vertex' mirror image stands."""
    grid = Icosphere(level)
    return grid.nearest(grid.vertices * torch.tensor([-1.0, 1.0, 1.0]))


def _mirrored(rig: CameraRig) -> CameraRig:
    """World and cameras each with left and right exchanged: two reflections make a rotation."""
    exchange = torch.diag(rig.world_from_camera.new_tensor([-1.0, 1.0, 1.0, 1.0]))
    origin = rig.origin * exchange.diagonal()[:3].to(rig.origin)
    return rig.replaced(world_from_camera=exchange @ rig.world_from_camera @ exchange, origin=origin)
