# SPDX-License-Identifier: Apache-2.0
"""What data sets of rendered scenes share: seeds, kinds, scale, and room for the rig."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

from torch.utils.data import Dataset

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.data.scenes.recipes import KINDS, make_scene
from sphericalvision.data.scenes.scene import Scene

__all__ = ["GENERATION", "NATURAL_MIN_DEPTH", "SeededScenes"]

#: Raised whenever the recipes or the renderer change what a seed looks like, so that old caches are not read.
GENERATION = 2
#: Least depth, and free space around the rig, of scenes at their natural scale (metres).
NATURAL_MIN_DEPTH, CLEAR_RADIUS = 0.55, 0.6


class SeededScenes(Dataset[dict[str, Any]]):
    """Scenes of consecutive seeds around a rig; subclasses say what a sample holds.

    Args:
        num_scenes: number of samples.
        rig: unbatched.
        kind: ``"room"``, ``"floating"``, or ``"mixed"`` (even seeds are rooms, odd ones floating objects).
        first_seed: seed of sample 0.
        samples_per_pixel: rays through each pixel.
        min_depth: least depth that the network tells apart, metres. Scenes scale with it: 0.55 is natural size.

    Raises:
        ArgumentError: unknown kind, fewer than one scene, a seed below 0, or cameras farther from the rig's
            centre than the space that scenes keep free.
    """

    def __init__(
        self,
        num_scenes: int,
        rig: CameraRig,
        kind: str,
        first_seed: int,
        samples_per_pixel: int,
        min_depth: float,
    ) -> None:
        check_choice("kind", kind, (*KINDS, "mixed"))
        for name, value, least in (("num_scenes", num_scenes, 1), ("first_seed", first_seed, 0)):
            if value < least:
                raise ArgumentError(f"{name}: expected at least {least}, got {value}")
        if not min_depth > 0:
            raise ArgumentError(f"min_depth: expected metres above 0, got {min_depth}")
        self.scale = min_depth / NATURAL_MIN_DEPTH
        radius = (rig.positions - rig.center).norm(dim=-1).max().item()
        if radius >= CLEAR_RADIUS * self.scale:
            raise ArgumentError(
                f"rig: its cameras lie up to {radius:.2f} m from its centre, but scenes of min_depth "
                f"{min_depth} keep only {CLEAR_RADIUS * self.scale:.2f} m free; give a min_depth above "
                f"{radius / CLEAR_RADIUS * NATURAL_MIN_DEPTH:.2f}"
            )
        self.num_scenes, self.rig, self.kind, self.first_seed = num_scenes, rig, kind, first_seed
        self.samples_per_pixel, self.min_depth = samples_per_pixel, min_depth

    def __len__(self) -> int:
        return self.num_scenes

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not -self.num_scenes <= index < self.num_scenes:
            raise IndexError(f"index {index} is outside a data set of {self.num_scenes} scenes")
        return self._sample(self.first_seed + index % self.num_scenes)

    @abstractmethod
    def is_cached(self, index: int) -> bool:
        """Whether all that was rendered for a sample lies in the cache; never without one."""

    @abstractmethod
    def _sample(self, seed: int) -> dict[str, Any]:
        """The sample of a seed."""

    def _frame(self, seed: int) -> str:
        return f"{self._kind(seed)}-{seed:08d}"

    def _kind(self, seed: int) -> str:
        return KINDS[seed % 2] if self.kind == "mixed" else self.kind

    def _scene(self, seed: int) -> Scene:
        return make_scene(
            self._kind(seed), seed, center=self.rig.center, scale=self.scale, clear_radius=CLEAR_RADIUS
        )
