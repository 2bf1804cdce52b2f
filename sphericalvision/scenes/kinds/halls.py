# SPDX-License-Identifier: Apache-2.0
"""Recipe for a large hall: columns in rows, beams, strip lights, and stacks of crates far apart."""

from __future__ import annotations

import math

import torch

from sphericalvision.scenes.kinds import rooms
from sphericalvision.scenes.kinds.furniture import place
from sphericalvision.scenes.kinds.palette import Palette
from sphericalvision.scenes.registry import register_scene
from sphericalvision.scenes.rendering.primitives import Part
from sphericalvision.scenes.rendering.scene import Lamp, Scene


@register_scene("hall")
def random_hall(generator: torch.Generator, clear_radius: float = 0.6) -> Scene:
    """A hall of 10 to 40 m with the rig somewhere in it, y down; not yet exposed (see `make_scene`)."""
    palette = Palette(generator)
    hall = rooms.Room.drawn(palette, clear_radius, (3.0, 20.0), (5.0, 11.0))
    rooms.build_shell(hall, {})
    _columns(hall)
    _beams(hall)
    _strip_lights(hall, palette.integer(2, 3))
    for _ in range(palette.integer(4, 12)):
        _crates(hall)
    rooms.fill(hall, palette.integer(4, 10))
    strength, blue = palette.uniform(0.08, 0.16), palette.uniform(0.9, 1.1)
    return hall.scene(strength * torch.tensor([1.0, 1.0, blue]))


def _columns(hall: rooms.Room) -> None:
    """Rows of equal columns from floor to ceiling, without those that would stand at the rig."""
    palette = hall.palette
    step, thickness = palette.uniform(3.0, 7.0), palette.uniform(0.12, 0.4)
    shape, material = palette.choose(("cylinder", "box")), palette.any_surface(1.0)
    shift = palette.uniform(0.0, step), palette.uniform(0.0, step)
    half = (hall.floor - hall.ceiling) / 2
    counts = [int((high - low) // step) for low, high in zip(hall.low, hall.high, strict=True)]
    for i in range(counts[0]):
        for k in range(counts[1]):
            x, z = hall.low[0] + shift[0] + i * step, hall.low[1] + shift[1] + k * step
            column = Part(shape, (x, hall.floor - half, z), (thickness, half, thickness), material)
            if x < hall.high[0] - thickness and z < hall.high[1] - thickness and hall.add([column]):
                hall.circles.append((x, z, 1.5 * thickness))


def _beams(hall: rooms.Room) -> None:
    """Beams across the ceiling."""
    palette = hall.palette
    (x0, z0), (x1, z1) = hall.low, hall.high
    step, material = palette.uniform(2.0, 5.0), palette.metal()
    deep, thick = palette.uniform(0.1, 0.4), palette.uniform(0.05, 0.15)
    for k in range(1, int((z1 - z0) / step)):
        center = ((x0 + x1) / 2, hall.ceiling + deep, z0 + k * step)
        hall.add([Part("box", center, ((x1 - x0) / 2, deep, thick), material, casts_shadow=False)])


def _strip_lights(hall: rooms.Room, count: int) -> None:
    """Long glowing boxes under the ceiling; the middle of each is the lamp that lights."""
    palette = hall.palette
    (x0, z0), (x1, z1) = hall.low, hall.high
    glow, y = palette.glowing((1.0, 0.98, palette.uniform(0.85, 1.0)), 1.5), hall.ceiling + 0.9
    power = 0.6 * math.sqrt((x1 - x0) * (z1 - z0)) * (hall.floor - hall.ceiling) / count
    for k in range(count):
        x = x0 + (k + palette.uniform(0.3, 0.7)) * (x1 - x0) / count
        z = palette.uniform(0.7 * z0 + 0.3 * z1, 0.3 * z0 + 0.7 * z1)
        hall.add([Part("box", (x, y, z), (0.08, 0.04, palette.uniform(0.6, 2.0)), glow, casts_shadow=False)])
        hall.lamps.append(Lamp((x, y + 0.1, z), (power, power, 0.95 * power), reach=2.0))


def _crates(hall: rooms.Room) -> None:
    """A few boxes or barrels on top of each other."""
    palette = hall.palette
    (x0, z0), (x1, z1) = hall.low, hall.high
    x, z = palette.uniform(x0 + 1, x1 - 1), palette.uniform(z0 + 1, z1 - 1)
    size, top, parts = palette.log_uniform(0.3, 1.0), 0.0, []
    for _ in range(palette.integer(1, 3)):
        wide, high, deep = palette.uniform(0.6, 1.0), palette.uniform(0.4, 0.8), palette.uniform(0.6, 1)
        half = (size * wide, size * high, size * deep)
        shape = "box" if palette.chance(0.8) else "cylinder"
        material = palette.any_surface(2 * size)
        parts.append(Part(shape, (0.0, -top - half[1], 0.0), half, material, yaw=palette.uniform(0, 0.4)))
        top, size = top + 2 * half[1] + 0.001, 0.9 * min(half[0], half[2])
    hall.stand(place(parts, 0.0, 0.0, 0.0, 0.0), x, z, palette.uniform(0, 2 * math.pi))
