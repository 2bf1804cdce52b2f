# SPDX-License-Identifier: Apache-2.0
"""Recipe for a furnished room with windows to all sides: what is behind a pane is far, and often without texture."""

from __future__ import annotations

import math

import torch

from sphericalvision.scenes.kinds import rooms
from sphericalvision.scenes.kinds.furniture import place
from sphericalvision.scenes.kinds.labels import labelled
from sphericalvision.scenes.kinds.palette import DAYLIGHT, Palette, level
from sphericalvision.scenes.registry import register_scene
from sphericalvision.scenes.rendering.primitives import Part
from sphericalvision.scenes.rendering.scene import Scene

OUTSIDE = 80.0
"""Metres to the sides that the ground outside has."""


@register_scene("glazed", other_sky=True)
def random_glazed_room(generator: torch.Generator, clear_radius: float = 0.6) -> Scene:
    """A room with windows to two or more sides, y down, the rig at its origin; not yet exposed.

    Windows are hatches to walls of glass. Bars divide one into any number of panes, or none; curtains hang beside some.
    Outside is the sky over a ground that may lie some floors lower, with or without houses and trees, mostly brighter
    than the room. A window without a view and a bright picture on a wall differ in little but the frame and the light.
    """
    palette = Palette(generator)
    room = rooms.Room.drawn(palette, clear_radius, (1.2, 6.0), (2.3, 3.6))
    order = torch.randperm(4, generator=generator).tolist()
    openings = {side: _opening(room, side) for side in order[: palette.integer(2, 4)]}
    rooms.build_shell(room, openings)
    rooms.hang_lamps(room, palette.integer(1, 2))
    for side, opening in openings.items():
        (rooms.add_window if palette.chance(0.15) else add_panes)(room, side, opening)
    if palette.chance(0.7):
        _outside(room)
    rooms.fill(room, palette.integer(3, 14))
    strength = palette.uniform(0.06, 0.16)
    return room.scene(strength * torch.ones(3), DAYLIGHT * palette.log_uniform(0.4, 3.0))


def _opening(room: rooms.Room, side: int) -> rooms.Opening:
    """A hatch, a window, a French window or most of the wall."""
    palette = room.palette
    kind = palette.uniform()
    if kind < 0.25:
        bottom = palette.uniform(0.8, 1.4)
        width, top = palette.uniform(0.3, 0.8), bottom + palette.uniform(0.3, 0.9)
    elif kind < 0.65:
        bottom = palette.uniform(0.3, 1.0)
        width, top = palette.uniform(0.8, 2.4), palette.uniform(1.6, 2.4)
    elif kind < 0.85:
        width, bottom, top = palette.uniform(0.8, 2.0), 0.02, palette.uniform(2.0, 2.4)
    else:
        width, bottom, top = palette.uniform(2.0, 9.0), palette.uniform(0.02, 0.6), palette.uniform(2.1, 3.3)
    return rooms.random_opening(room, side, width, bottom, top)


def add_panes(room: rooms.Room, side: int, opening: rooms.Opening) -> None:
    """A frame, bars between panes, and perhaps curtains; what is behind is left as it is."""
    palette = room.palette
    yaw, x, z, start, end = room.sides()[side]
    first, last, upper, lower = opening
    material = palette.paint() if palette.chance(0.6) else palette.metal()
    if palette.chance(0.85):
        rooms.add_frame(room, side, opening, material, "window")
    along, down, wide, high = (first + last) / 2, (upper + lower) / 2, last - first, lower - upper
    thick = palette.uniform(0.012, 0.04)
    upright, level = palette.choose(((0, 0), (1, 0), (1, 1), (2, 1), (int(wide / 0.7), int(high / 0.9))))
    bars = [
        Part("box", (first + wide * k / (upright + 1), down, 0.0), (thick, high / 2, thick), material)
        for k in range(1, upright + 1)
    ]
    bars += [
        Part("box", (along, upper + high * k / (level + 1), 0.0), (wide / 2, thick, thick), material)
        for k in range(1, level + 1)
    ]
    if bars:
        room.add(labelled(place(bars, x, 0.0, z, yaw), "window"))
    if palette.chance(0.3):
        cloth, drawn = palette.any_surface(1.0), palette.uniform(0.1, 0.4) * wide
        top, bottom = max(upper - 0.1, room.ceiling), min(lower + 0.1, room.floor)
        for left, right in ((first - 0.2, first + drawn), (last - drawn, last + 0.2)):
            piece = (max(left, start), min(right, end), top, bottom)
            room.add(labelled(rooms.wall_piece(cloth, yaw, x, z, piece, casts=False, lift=0.08), "window"))


def _outside(room: rooms.Room) -> None:
    """A ground below or at the room's floor, and houses and trees on it."""
    palette = room.palette
    below = room.floor + (0.05 if palette.chance(0.5) else palette.log_uniform(1.0, 15.0))
    ground = _shone_upon(palette, palette.patterned(tile=palette.uniform(1.5, 6.0)))
    pieces = [level(0.0, below, 0.0, OUTSIDE, OUTSIDE, ground)]
    reach = math.hypot(*(max(abs(a), abs(b)) for a, b in zip(room.low, room.high, strict=True)))
    for _ in range(palette.integer(0, 6)):
        away, turn = reach + palette.log_uniform(1.5, 50.0), palette.uniform(0, 2 * math.pi)
        size = 0.35 * (away - reach)
        shape = "ellipsoid" if palette.chance(0.4) else "box"
        wide, deep = palette.uniform(0.3, 1.0) * size, palette.uniform(0.3, 1.0) * size
        high = palette.uniform(0.5, 6.0)
        skin = palette.any_surface(palette.uniform(1.0, 4.0)) if palette.chance(0.6) else palette.paint()
        center = (away * math.sin(turn), below - high, away * math.cos(turn))
        material, yaw = _shone_upon(palette, skin), palette.uniform(0, math.pi)
        pieces.append(Part(shape, center, (wide, high, deep), material, yaw=yaw, casts_shadow=False))
    room.parts += labelled(pieces, "window")


def _shone_upon(palette: Palette, material: int) -> int:
    """Give a material the light of day, which lamps in a room are not: it looks as if it shone."""
    palette.materials[material] = palette.materials[material]._replace(emission=palette.uniform(0.3, 1.2))
    return material
