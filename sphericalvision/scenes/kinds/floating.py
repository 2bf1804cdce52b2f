# SPDX-License-Identifier: Apache-2.0
"""Recipe for objects that float around the rig at every distance and attitude, in front of a far textured
shell."""

from __future__ import annotations

import math

import torch

from sphericalvision.scenes.kinds.palette import Palette
from sphericalvision.scenes.registry import register_scene
from sphericalvision.scenes.rendering.primitives import SHAPES, Part, pack
from sphericalvision.scenes.rendering.scene import Lamp, Scene


@register_scene("floating")
def random_floating_objects(generator: torch.Generator, clear_radius: float = 0.6) -> Scene:
    """Many textured objects and thin rods in mid-air, the rig at the origin; not yet exposed (see
    `make_scene`).
    """
    palette = Palette(generator)
    far = palette.log_uniform(12.0, 80.0)
    shell = palette.photograph(far * palette.uniform(0.7, 1.6), emission=palette.uniform(0.12, 0.3))
    shape = palette.choose(("box", "ellipsoid"))
    half = (far, far * palette.uniform(0.6, 1.0), far)
    pieces = [Part(shape, (0.0, 0.0, 0.0), half, shell, rotation=palette.rotation(), casts_shadow=False)]
    # A spread over inverse distance (not distance) fills all depth hypotheses alike.
    for _ in range(palette.integer(40, 90)):
        distance = 1 / palette.uniform(1 / min(0.8 * far, 20.0), 1 / (clear_radius + 0.1))
        size = distance * palette.log_uniform(0.05, 0.4)
        candidate = _floating(palette, distance, size)
        gap = pack([candidate]).distance_from(torch.zeros(3)).item()
        if gap >= clear_radius:
            pieces.append(candidate)
    lamps = []
    for _ in range(2):
        spacing = palette.uniform(4.0, 10.0)
        x, y, z = _direction(palette)
        tint = palette.color(0.8, 1.0, 0.25)
        power = 0.3 * spacing**2 * palette.uniform(0.6, 1.4)
        color = (power * tint[0], power * tint[1], power * tint[2])
        lamps.append(Lamp((spacing * x, -spacing * abs(y), spacing * z), color, spacing))
    return palette.scene(pieces, lamps, ambient=palette.uniform(0.1, 0.2) * torch.ones(3))


def _direction(palette: Palette) -> tuple[float, float, float]:
    """A direction drawn uniformly from the sphere."""
    height, angle = palette.uniform(-1, 1), palette.uniform(0, 2 * math.pi)
    across = math.sqrt(1 - height**2)
    return across * math.sin(angle), height, across * math.cos(angle)


def _floating(palette: Palette, distance: float, size: float) -> Part:
    x, y, z = (distance * c for c in _direction(palette))
    half = tuple(size * palette.uniform(0.3, 1.0) for _ in range(3))
    shape = palette.choose(SHAPES)
    if palette.chance(0.15):
        shape, half = palette.choose(("box", "cylinder")), (0.05 * size, 2 * size, 0.05 * size)
    material = palette.photograph(1.5 * size) if palette.chance(0.5) else palette.patterned(tile=1.5 * size)
    return Part(shape, (x, y, z), (half[0], half[1], half[2]), material, rotation=palette.rotation())
