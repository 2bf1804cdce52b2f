# SPDX-License-Identifier: Apache-2.0
"""Recipe for a long corridor: closed doors along both walls, lamps in a row, and a bright end."""

from __future__ import annotations

import math

import torch

from sphericalvision.scenes.kinds import rooms
from sphericalvision.scenes.kinds.furniture import place
from sphericalvision.scenes.kinds.palette import DAYLIGHT, Palette
from sphericalvision.scenes.registry import register_scene
from sphericalvision.scenes.rendering.primitives import Part
from sphericalvision.scenes.rendering.scene import Lamp, Scene


@register_scene("corridor")
def random_corridor(generator: torch.Generator, clear_radius: float = 0.6) -> Scene:
    """A corridor of 10 to 45 m, 1.5 to 3 m wide, around the rig, y down; not yet exposed (see `make_scene`)."""
    palette = Palette(generator)
    left, right = palette.uniform(0.75, 1.5), palette.uniform(0.75, 1.5)
    back, front = palette.log_uniform(2.0, 15.0), palette.log_uniform(8.0, 30.0)
    height = palette.uniform(2.2, 3.2)
    floor = palette.uniform(0.75, min(1.6, height - 0.75))
    corridor = rooms.Room(palette, (-left, -back), (right, front), floor, floor - height, clear_radius)
    openings: dict[int, rooms.Opening] = {}
    if palette.chance(0.6):  # the far end, which is the first of the four sides
        openings[0] = rooms.random_opening(corridor, 0, left + right, 0.9, height - 0.2)
    rooms.build_shell(corridor, openings)
    for opening in openings.values():
        rooms.add_window(corridor, 0, opening)
    _doors(corridor)
    _lamps(corridor)
    rooms.fill(corridor, palette.integer(1, 5))
    strength, tint = palette.uniform(0.08, 0.16), [1.0, palette.uniform(0.9, 1.0), palette.uniform(0.8, 1)]
    return corridor.scene(strength * torch.tensor(tint), DAYLIGHT * palette.uniform(0.5, 1.2))


def _doors(corridor: rooms.Room) -> None:
    """Closed doors with frames and handles along the two long walls."""
    palette = corridor.palette
    material, frame, handle = palette.any_surface(1.5), palette.paint(), palette.metal()
    high = min(palette.uniform(1.95, 2.15), corridor.floor - corridor.ceiling - 0.1)
    for side in (1, 3):
        yaw, x, z, start, end = corridor.sides()[side]
        step = palette.uniform(2.0, 5.0)
        for k in range(int((end - start - 1) / step)):
            if palette.chance(0.25):
                continue
            along, down = start + 0.8 + k * step + palette.uniform(0.0, 0.3), corridor.floor - high / 2
            panel = (0.43, high / 2 - 0.02, 0.02)
            leaf = [
                Part("box", (along, down, 0.0), (0.5, high / 2 + 0.05, 0.04), frame, casts_shadow=False),
                Part("box", (along, down + 0.02, -0.03), panel, material, casts_shadow=False),
                Part("ellipsoid", (along + 0.36, down + 0.05, -0.09), (0.05, 0.015, 0.03), handle),
            ]
            corridor.add(place(leaf, x, 0.0, z, yaw))


def _lamps(corridor: rooms.Room) -> None:
    """Flat lamps in a row under the ceiling, of which the nearest few light."""
    palette = corridor.palette
    start, end = corridor.low[1], corridor.high[1]
    step, middle = palette.uniform(2.5, 5.0), (corridor.low[0] + corridor.high[0]) / 2
    warm = palette.uniform(0.75, 1.0)
    glow = palette.glowing((1.0, 0.5 + 0.5 * warm, warm), 1.4)
    positions = sorted((start + (k + 0.5) * step for k in range(int((end - start) / step))), key=abs)
    for number, z in enumerate(positions):
        flat = Part("box", (middle, corridor.ceiling + 0.03, z), (0.15, 0.03, 0.5), glow, casts_shadow=False)
        corridor.add([flat])
        if number < 4:
            power = palette.uniform(1.0, 1.6) * math.sqrt(step / 3)
            color = (power, power * (0.5 + 0.5 * warm), power * warm)
            corridor.lamps.append(Lamp((middle, corridor.ceiling + 0.15, z), color, reach=1.2))
