# SPDX-License-Identifier: Apache-2.0
"""Rendered frames as they go to disk: images of the cameras and a panorama of the true depth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch.utils.data import Dataset

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.scenes.meshes import MeshFiles
from sphericalvision.scenes.world import NATURAL_MIN_DEPTH, World
from sphericalvision.sphere import Equirectangular

__all__ = ["RenderedFrames"]


class RenderedFrames(Dataset[dict[str, Any]]):
    """Frames of procedural scenes, each the scene of its own seed.

    Args:
        rig: cameras that take the images.
        frames: frame numbers.
        first_seed: seed of frame 1.
        kind: of ``make_scene``, or a mixture: "mixed" or "all".
        samples_per_pixel: rays per pixel.
        height: rows of the ground-truth panorama; it has twice as many columns.
        scale: multiplies the scene's lengths; for larger rigs.
        meshes: of which scenes are made in place of a kind.
        carrier: what carries the rig and is in view: "pole", "robot" or "vehicle".
    """

    def __init__(
        self,
        rig: CameraRig,
        frames: Sequence[int],
        first_seed: int = 0,
        kind: str = "mixed",
        samples_per_pixel: int = 4,
        height: int = 320,
        scale: float = 1.0,
        meshes: MeshFiles | None = None,
        carrier: str | None = None,
    ) -> None:
        if not height > 0:
            raise ArgumentError(f"height: expected a positive number of rows, got {height}")
        self.frames, self.first_seed = frames, first_seed
        self.world = World(
            rig,
            kind,
            scale * NATURAL_MIN_DEPTH,
            meshes,
            carrier=carrier,
            carrier_counts=True,
            samples_per_pixel=samples_per_pixel,
        )
        self.world.check_free_space(rig)
        self.directions = Equirectangular(height, 2 * height).directions

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> dict[str, Any]:
        number = self.frames[index]
        frame = self.world.frame(self.first_seed + number - 1)
        inverse_depth = frame.inverse_depth(self.directions)
        return {
            "images": frame.images,
            "inverse_depth": inverse_depth,
            "valid": inverse_depth < float("inf"),
            "rig": frame.rig,
            "frame": f"{number:05d}",
        }
