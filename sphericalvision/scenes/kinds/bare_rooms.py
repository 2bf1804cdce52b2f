# SPDX-License-Identifier: Apache-2.0
"""Recipe for a room of bare walls: paint in one colour, next to no texture and hardly anything in it."""

from __future__ import annotations

import torch

from sphericalvision.scenes.kinds.palette import Palette
from sphericalvision.scenes.kinds.rooms import (
    Opening,
    Room,
    add_door,
    add_window,
    furnish,
    hang_lamps,
    random_opening,
    wall_piece,
)
from sphericalvision.scenes.registry import register_scene
from sphericalvision.scenes.rendering.primitives import Part, pack
from sphericalvision.scenes.rendering.scene import Color, Scene, pack_lamps, pack_materials

__all__ = ["random_bare_room"]


@register_scene("bare")
def random_bare_room(generator: torch.Generator, clear_radius: float = 0.6) -> Scene:
    """A room without pictures on its plain walls, the rig at its origin; not yet exposed (see `make_scene`).

    Args:
        generator: source of every random choice.
        clear_radius: nothing stands nearer to the origin than this (metres).
    """
    palette = Palette(generator)
    sides = [palette.log_uniform(1.2, 5.0) for _ in range(4)]
    height = palette.uniform(2.3, 3.4)
    floor = palette.uniform(0.75, min(1.7, height - 0.8))
    room = Room(palette, (-sides[0], -sides[1]), (sides[2], sides[3]), floor, floor - height, clear_radius)
    tone = palette.color(0.5, 0.9, 0.3)
    opening: tuple[int, Opening] | None = None
    if palette.chance(0.6):
        side = palette.integer(0, 3)
        opening = side, random_opening(room, side, palette.uniform(0.8, 1.4), 0.0, 2.0)
    _plain_shell(room, tone, opening)
    hang_lamps(room, palette.integer(1, 2))
    if opening is not None:
        (add_door if palette.chance(0.5) else add_window)(room, *opening)
    furnish(room, palette.integer(1, 4))
    return Scene(
        primitives=pack(room.parts),
        materials=pack_materials(palette.materials),
        lamps=pack_lamps(room.lamps),
        ambient=palette.uniform(0.1, 0.18) * torch.ones(3),
        background=torch.tensor([[0.45, 0.6, 0.9], [0.35, 0.33, 0.3]]) * palette.uniform(0.5, 1.2),
        exposure=torch.tensor(1.0),
    )


def _plain_shell(room: Room, tone: Color, opening: tuple[int, Opening] | None) -> None:
    """Walls, ceiling and floor of nearly one tone each, with skirting boards, and a hole where the opening is."""
    palette = room.palette
    wall = palette.patterned(("noise",), 2.0, palette.uniform(0.0, 0.06), tone)
    roof = palette.patterned(("noise",), 2.0, 0.02, palette.color(0.8, 0.95, 0.05))
    grain = palette.uniform(0.0, 0.08) if palette.chance(0.5) else palette.uniform(0.3, 0.7)
    ground = palette.patterned(("noise", "wood", "weave"), 1.5, grain, palette.color(0.25, 0.7, 0.3))
    skirting = palette.patterned(("noise",), 1.0, 0.03, palette.color(0.7, 0.95, 0.1))
    (x0, z0), (x1, z1) = room.low, room.high
    flat = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
    for y, material in ((room.floor, ground), (room.ceiling, roof)):
        middle, half = ((x0 + x1) / 2, y, (z0 + z1) / 2), ((x1 - x0) / 2, (z1 - z0) / 2, 1.0)
        room.parts.append(Part("rectangle", middle, half, material, rotation=flat))
    for side, (yaw, x, z, start, end) in enumerate(room.sides()):
        pieces: list[Opening] = [(start, end, room.ceiling, room.floor)]
        boards = [(start, end)]
        if opening is not None and opening[0] == side:
            first, last, upper, lower = opening[1]
            pieces = [
                (start, first, room.ceiling, room.floor),
                (last, end, room.ceiling, room.floor),
                (first, last, room.ceiling, upper),
                (first, last, lower, room.floor),
            ]
            boards = [(start, first), (last, end)]
        for piece in pieces:
            room.parts += wall_piece(wall, yaw, x, z, piece, casts=True)
        for begin, finish in boards:
            board = (begin, finish, room.floor - 0.08, room.floor)
            room.parts += wall_piece(skirting, yaw, x, z, board, casts=False, lift=0.01)
