# SPDX-License-Identifier: Apache-2.0
"""Which scene a seed stands for, and whether a rig fits into it."""

from __future__ import annotations

from dataclasses import dataclass

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.data.rendering.scene import Scene
from sphericalvision.data.scenes.recipes import kind_of, make_scene

__all__ = ["GENERATION", "HELD_OUT_SEED", "NATURAL_MIN_DEPTH", "SeededScenes"]

#: Raised whenever the recipes or the renderer change what a seed looks like, so that old caches are not read.
GENERATION = 2
#: Scenes of this seed and above are kept for comparing methods: no training, validation or test of one uses them.
HELD_OUT_SEED = 10_000_000
#: Least depth, and free space around the rig, of scenes at their natural scale (metres).
NATURAL_MIN_DEPTH, CLEAR_RADIUS = 0.55, 0.6


@dataclass(frozen=True)
class SeededScenes:
    """Scenes around a rig, one for each seed.

    Args:
        rig: unbatched.
        kind: of ``make_scene``, or of ``kind_of`` a mixture.
        min_depth: least depth that the network tells apart, metres. Scenes scale with it: 0.55 is natural size.

    Raises:
        ArgumentError: unknown kind, or cameras farther from the rig's centre than the space that scenes keep free.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> SeededScenes(ring_rig(4), "mixed").name(7)
        'floating-00000007'
    """

    rig: CameraRig
    kind: str
    min_depth: float = NATURAL_MIN_DEPTH

    def __post_init__(self) -> None:
        kind_of(self.kind, 0)
        if not self.min_depth > 0:
            raise ArgumentError(f"min_depth: expected metres above 0, got {self.min_depth}")
        radius = (self.rig.positions - self.rig.center).norm(dim=-1).max().item()
        if radius >= CLEAR_RADIUS * self.scale:
            raise ArgumentError(
                f"rig: its cameras lie up to {radius:.2f} m from its centre, but scenes of min_depth "
                f"{self.min_depth} keep only {CLEAR_RADIUS * self.scale:.2f} m free; give a min_depth above "
                f"{radius / CLEAR_RADIUS * NATURAL_MIN_DEPTH:.2f}"
            )

    @property
    def scale(self) -> float:
        """Of the scenes' lengths."""
        return self.min_depth / NATURAL_MIN_DEPTH

    def name(self, seed: int) -> str:
        """Kind and seed of a scene, as they stand in ``frame``."""
        return f"{kind_of(self.kind, seed)}-{seed:08d}"

    def make(self, seed: int) -> Scene:
        """The scene of a seed."""
        kind = kind_of(self.kind, seed)
        return make_scene(kind, seed, center=self.rig.center, scale=self.scale, clear_radius=CLEAR_RADIUS)
