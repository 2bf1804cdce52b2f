# SPDX-License-Identifier: Apache-2.0
"""Rendered frames as they go to disk: fisheye images and a ground-truth panorama."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch.utils.data import Dataset

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import Icosphere
from sphericalvision.scenes.recipes import kind_of, make_scene, ray_depth, render_rig
from sphericalvision.scenes.seeded_scenes import NATURAL_MIN_DEPTH, MeshFiles, SeededScenes
from sphericalvision.sphere import Equirectangular

__all__ = ["RenderedFrames", "SceneDepths"]


class RenderedFrames(Dataset[dict[str, Any]]):
    """Frames of procedural scenes, each the scene of its own seed.

    Args:
        rig: cameras that take the pictures.
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
        self.scenes = SeededScenes(rig, kind, scale * NATURAL_MIN_DEPTH, meshes, carrier)
        self.rig, self.frames, self.first_seed = rig, frames, first_seed
        self.samples_per_pixel, self.height = samples_per_pixel, height

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> dict[str, Any]:
        frame = self.frames[index]
        scene = self.scenes.make(self.first_seed + frame - 1)
        depth = ray_depth(scene, self.rig.center, Equirectangular(self.height, 2 * self.height).directions)
        return {
            "images": render_rig(scene, self.rig, self.samples_per_pixel),
            "inverse_depth": depth.reciprocal(),
            "valid": depth > 0,
            "rig": self.rig,
            "frame": f"{frame:05d}",
        }


class SceneDepths(Dataset[dict[str, Any]]):
    """Ground truth alone of scenes, at the vertices of an icosphere; nothing is rendered.

    Args:
        rig: its centre is where depth is measured from.
        num_scenes: how many.
        level: icosphere level of the images; depth is two levels below.
        first_seed: seed of the first scene.
        kind: of ``make_scene``, or a mixture: "mixed" or "all".
        scale: multiplies the scenes' lengths.
    """

    def __init__(
        self, rig: CameraRig, num_scenes: int, level: int, first_seed: int, kind: str, scale: float
    ) -> None:
        self.center, self.num_scenes, self.first_seed = rig.center, num_scenes, first_seed
        self.kind, self.scale = kind, scale
        self.directions = Icosphere(level - 2).vertices

    def __len__(self) -> int:
        return self.num_scenes

    def __getitem__(self, index: int) -> dict[str, Any]:
        seed = self.first_seed + index
        scene = make_scene(kind_of(self.kind, seed), seed, scale=self.scale, center=self.center)
        depth = ray_depth(scene, self.center, self.directions)
        return {"inverse_depth": depth.reciprocal(), "valid": depth > 0}
