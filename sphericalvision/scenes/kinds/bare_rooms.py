# SPDX-License-Identifier: Apache-2.0
"""Recipe for a room of bare walls: paint in one colour, next to no texture and hardly anything in it."""

from __future__ import annotations

import torch

from sphericalvision.scenes.kinds import rooms
from sphericalvision.scenes.kinds.palette import DAYLIGHT, Palette
from sphericalvision.scenes.registry import register_scene
from sphericalvision.scenes.rendering.scene import Color, Scene


@register_scene("bare")
def random_bare_room(generator: torch.Generator, clear_radius: float = 0.6) -> Scene:
    """A room without pictures on its plain walls, the rig at its origin; not yet exposed (see `make_scene`)."""
    palette = Palette(generator)
    room = rooms.Room.drawn(palette, clear_radius, (1.2, 5.0), (2.3, 3.4))
    tone = palette.color(0.5, 0.9, 0.3)
    openings: dict[int, rooms.Opening] = {}
    if palette.chance(0.6):
        side = palette.integer(0, 3)
        openings[side] = rooms.random_opening(room, side, palette.uniform(0.8, 1.4), 0.0, 2.0)
    _plain_shell(room, tone, openings)
    rooms.hang_lamps(room, palette.integer(1, 2))
    for side, opening in openings.items():
        (rooms.add_door if palette.chance(0.5) else rooms.add_window)(room, side, opening)
    rooms.furnish(room, palette.integer(1, 4))
    strength = palette.uniform(0.1, 0.18)
    return room.scene(strength * torch.ones(3), DAYLIGHT * palette.uniform(0.5, 1.2))


def _plain_shell(room: rooms.Room, tone: Color, openings: dict[int, rooms.Opening]) -> None:
    """Walls, ceiling and floor of nearly one tone each, with skirting boards, and a hole where the opening is."""
    palette = room.palette
    wall = palette.patterned(("noise",), 2.0, palette.uniform(0.0, 0.06), tone)
    roof = palette.patterned(("noise",), 2.0, 0.02, palette.color(0.8, 0.95, 0.05))
    grain = palette.uniform(0.0, 0.08) if palette.chance(0.5) else palette.uniform(0.3, 0.7)
    ground = palette.patterned(("noise", "wood", "weave"), 1.5, grain, palette.color(0.25, 0.7, 0.3))
    skirting = palette.patterned(("noise",), 1.0, 0.03, palette.color(0.7, 0.95, 0.1))
    rooms.add_shell(room, ground, roof, dict.fromkeys(range(4), wall), openings, casts=True)
    for side, (yaw, x, z, start, end) in enumerate(room.sides()):
        first, last, _, _ = openings.get(side, (end, end, 0.0, 0.0))
        for begin, finish in ((start, first), (last, end)):
            board = (begin, finish, room.floor - 0.08, room.floor)
            room.parts += rooms.wall_piece(skirting, yaw, x, z, board, casts=False, lift=0.01)
