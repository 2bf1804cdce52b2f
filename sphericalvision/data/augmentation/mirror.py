# SPDX-License-Identifier: Apache-2.0
"""Mirrored samples: the world with left and right exchanged."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.data.augmentation.fivefold import moved_on_icosphere
from sphericalvision.icosphere import Icosphere
from sphericalvision.icosphere.topology import level_from_num_vertices

__all__ = ["Mirror"]


class Mirror:
    """Augmentation of a sample on the icosphere: left and right of the world exchanged, rig included.

    The icosphere maps onto itself, so nothing is interpolated: ``images``, ``seen``, ``inverse_depth``, ``valid`` and
    all of ``fixed`` move to where their mirror image is. Cameras keep their models, so lenses must be symmetrical, as
    those of ``random_rig`` are; images of the cameras themselves and masks would have to be flipped, and are refused.

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
    return values.index_select(-1, mirror_ids(level_from_num_vertices(values.shape[-1])).to(values.device))


@lru_cache
def mirror_ids(level: int) -> Tensor:
    """Return at which vertex ``(V,)`` each vertex' mirror image stands."""
    grid = Icosphere(level)
    return grid.nearest(grid.vertices * torch.tensor([-1.0, 1.0, 1.0]))


def _mirrored(rig: CameraRig) -> CameraRig:
    """World and cameras each with left and right exchanged: two reflections make a rotation."""
    exchange = torch.diag(rig.world_from_camera.new_tensor([-1.0, 1.0, 1.0, 1.0]))
    return CameraRig(rig.cameras, exchange @ rig.world_from_camera @ exchange)
