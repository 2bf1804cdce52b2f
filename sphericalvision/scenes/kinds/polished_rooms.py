# SPDX-License-Identifier: Apache-2.0
"""Recipe for a furnished room whose polished floor mirrors it, sometimes with a mirror on a wall."""

from __future__ import annotations

from dataclasses import replace

import torch

from sphericalvision.scenes.kinds import rooms
from sphericalvision.scenes.kinds.furniture import place
from sphericalvision.scenes.kinds.palette import DAYLIGHT, Palette
from sphericalvision.scenes.registry import register_scene
from sphericalvision.scenes.rendering.primitives import Part
from sphericalvision.scenes.rendering.scene import Material, Scene


@register_scene("polished")
def random_polished_room(generator: torch.Generator, clear_radius: float = 0.6) -> Scene:
    """A room on a floor that mirrors a third to three quarters of its light; not yet exposed (see `make_scene`).

    Depth is that of the floor itself, which the mirrored room below it is not: what photo-consistency gets wrong.
    """
    palette = Palette(generator)
    room = rooms.Room.drawn(palette, clear_radius, (1.5, 8.0), (2.4, 4.5))
    side = palette.integer(0, 3)
    window = rooms.random_opening(room, side, palette.uniform(1.0, 2.5), 0.5, 2.1)
    rooms.build_shell(room, {side: window})
    _polish(room)
    rooms.hang_lamps(room, palette.integer(1, 2))
    rooms.add_window(room, side, window)
    if palette.chance(0.4):
        _wall_mirror(room, (side + 1) % 4)
    rooms.fill(room, palette.integer(6, 14), rug=False)
    strength = palette.uniform(0.08, 0.16)
    return room.scene(strength * torch.ones(3), DAYLIGHT * palette.uniform(0.5, 1.2))


def _polish(room: rooms.Room) -> None:
    """Give the floor, which is the first part of a shell, a material that mirrors."""
    palette = room.palette
    names = ("marble", "tiles", "noise", "checks")
    fraction = palette.uniform(0.33, 0.75)
    ground = palette.patterned(names, palette.uniform(1.0, 2.5), palette.uniform(0.1, 0.7), mirror=fraction)
    room.parts[0] = replace(room.parts[0], material=ground)


def _wall_mirror(room: rooms.Room, side: int) -> None:
    """A mirror in a frame on a wall."""
    palette = room.palette
    yaw, x, z, start, end = room.sides()[side]
    wide, high = palette.uniform(0.3, 0.4) * (end - start), palette.uniform(0.4, 0.9)
    along = palette.uniform(start + 1.1 * wide, end - 1.1 * wide)
    down = room.floor - 0.3 - high
    glass = palette.add(Material(texture=0, dark=(0.05, 0.06, 0.06), bright=(0.05, 0.06, 0.06), mirror=0.9))
    size, frame = (wide + 0.04, high + 0.04, 0.02), palette.metal()
    board = [
        Part("box", (along, down, 0.0), size, frame, casts_shadow=False),
        Part("rectangle", (along, down, -0.022), (wide, high, 1.0), glass, casts_shadow=False),
    ]
    room.add(place(board, x, 0.0, z, yaw))
