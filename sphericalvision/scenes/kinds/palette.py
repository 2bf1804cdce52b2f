# SPDX-License-Identifier: Apache-2.0
"""Random numbers and materials for scene recipes, from one generator."""

from __future__ import annotations

import colorsys
import math
from collections.abc import Sequence
from typing import TypeVar

import torch

from sphericalvision.scenes.rendering.primitives import Part, pack
from sphericalvision.scenes.rendering.scene import Color, Lamp, Material, Scene, pack_lamps, pack_materials
from sphericalvision.scenes.rendering.textures import ALL_PATTERNS, PATTERNS, PHOTOGRAPHS, VARIANTS

Item = TypeVar("Item")

DAYLIGHT = torch.tensor([[0.45, 0.6, 0.9], [0.35, 0.33, 0.3]])
"""A blue sky over grey ground, as a background."""


class Palette:
    """Draws numbers from a generator and collects the materials that a recipe asks for.

    Every method that makes a material returns its number, for ``Part.material``.
    """

    def __init__(self, generator: torch.Generator) -> None:
        self.generator = generator
        self.materials: list[Material] = []

    def uniform(self, low: float = 0.0, high: float = 1.0) -> float:
        """A number in [low, high)."""
        return low + (high - low) * torch.rand((), generator=self.generator).item()

    def log_uniform(self, low: float, high: float) -> float:
        """A number in [low, high) whose logarithm is uniform."""
        return math.exp(self.uniform(math.log(low), math.log(high)))

    def integer(self, low: int, high: int) -> int:
        """A whole number from low to high, both included."""
        return int(torch.randint(low, high + 1, (), generator=self.generator).item())

    def chance(self, probability: float) -> bool:
        """True with the given probability."""
        return self.uniform() < probability

    def choose(self, items: Sequence[Item]) -> Item:
        """One of the items."""
        return items[self.integer(0, len(items) - 1)]

    def color(self, low: float = 0.15, high: float = 0.85, saturation: float = 0.7) -> Color:
        """A linear colour with brightness in [low, high) and at most the given saturation."""
        return colorsys.hsv_to_rgb(self.uniform(), saturation * self.uniform(), self.uniform(low, high))

    def rotation(self) -> list[list[float]]:
        """A rotation matrix drawn uniformly from all."""
        q = torch.randn(4, generator=self.generator, dtype=torch.float64)
        w, x, y, z = (q / q.norm()).tolist()
        return [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]

    def add(self, material: Material) -> int:
        """Keep a material."""
        self.materials.append(material)
        return len(self.materials) - 1

    def photograph(self, tile: float | tuple[float, float], emission: float = 0.0) -> int:
        """A photograph, in its own colours or tinted."""
        tint = (1.0, 1.0, 1.0) if self.chance(0.6) else self.color(0.6, 1.0)
        return self.add(
            Material(
                texture=self.integer(0, len(PHOTOGRAPHS) - 1),
                dark=(0.02, 0.02, 0.02),
                bright=tint,
                tile=tile if isinstance(tile, tuple) else (tile, tile),
                emission=emission,
            )
        )

    def patterned(
        self,
        names: Sequence[str] = PATTERNS,
        tile: float = 1.0,
        contrast: float = 1.0,
        bright: Color | None = None,
        mirror: float = 0.0,
    ) -> int:
        """A pattern between two colours; ``contrast`` 0 leaves one plain colour."""
        number = tuple(ALL_PATTERNS).index(self.choose(names)) * VARIANTS + self.integer(0, VARIANTS - 1)
        bright = bright or self.color(0.3, 0.9)
        other = self.color(0.02, 0.5)
        dark = tuple(b + contrast * (o - b) for b, o in zip(bright, other, strict=True))
        return self.add(
            Material(
                texture=len(PHOTOGRAPHS) + number,
                dark=(dark[0], dark[1], dark[2]),
                bright=bright,
                tile=(tile, tile),
                turn=self.choose((0.0, math.pi / 2)),
                offset=(self.uniform(), self.uniform()),
                mirror=mirror,
            )
        )

    def wood(self) -> int:
        """Boards between a dark and a light brown."""
        hue, saturation, value = self.uniform(0.05, 0.11), self.uniform(0.3, 0.75), self.uniform(0.25, 0.8)
        bright = colorsys.hsv_to_rgb(hue, saturation, value)
        return self.patterned(("wood",), self.uniform(0.4, 1.2), self.uniform(0.4, 0.9), bright)

    def paint(self) -> int:
        """A nearly plain colour with a faint grain, as on walls and lacquer."""
        return self.patterned(
            ("noise",), self.uniform(0.5, 2), self.uniform(0.2, 0.55), self.color(0.35, 0.9, 0.6)
        )

    def any_surface(self, tile: float = 1.0) -> int:
        """Whatever furniture may be covered with."""
        kind = self.uniform()
        if kind < 0.25:
            return self.wood()
        if kind < 0.4:
            return self.paint()
        if kind < 0.65:
            return self.photograph(tile * self.uniform(0.6, 1.6))
        return self.patterned(tile=tile * self.uniform(0.4, 1.4), contrast=self.uniform(0.5, 1.0))

    def metal(self) -> int:
        """Dark or light grey for thin things."""
        return self.patterned(("noise",), 0.3, 0.3, self.color(0.05, 0.7, 0.15))

    def glowing(self, color: Color, emission: float) -> int:
        """A plain surface that gives off light."""
        return self.add(Material(texture=0, dark=color, bright=color, emission=emission))

    def scene(
        self,
        parts: Sequence[Part],
        lamps: Sequence[Lamp],
        ambient: torch.Tensor,
        background: torch.Tensor | None = None,
        fog: float = 0.0,
    ) -> Scene:
        """The scene of these parts in the palette's materials, under a black sky unless told; not yet exposed."""
        return Scene(
            primitives=pack(parts),
            materials=pack_materials(self.materials),
            lamps=pack_lamps(lamps),
            ambient=ambient,
            background=torch.zeros(2, 3) if background is None else background,
            exposure=torch.tensor(1.0),
            fog=fog,
        )


def level(
    x: float, y: float, z: float, wide: float, deep: float, material: int, casts: bool = False, label: int = 0
) -> Part:
    """A level rectangle around (x, y, z) that reaches ``wide`` and ``deep`` metres along x and z to either side."""
    flat = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
    half = (wide, deep, 1.0)
    return Part("rectangle", (x, y, z), half, material, rotation=flat, casts_shadow=casts, label=label)
