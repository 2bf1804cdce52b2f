# SPDX-License-Identifier: Apache-2.0
"""Recipe for interiors with surfaces that shine: light boxes, screens, luminous ceilings, mirrored by the floor."""

from __future__ import annotations

import math

import torch

from sphericalvision.scenes.kinds import rooms
from sphericalvision.scenes.kinds.furniture import place
from sphericalvision.scenes.kinds.glazed import add_panes
from sphericalvision.scenes.kinds.labels import labelled
from sphericalvision.scenes.kinds.palette import DAYLIGHT, Palette, level
from sphericalvision.scenes.kinds.patchwork import lamps_near
from sphericalvision.scenes.registry import register_scene
from sphericalvision.scenes.rendering.primitives import Part
from sphericalvision.scenes.rendering.scene import Scene


@register_scene("lit", other_sky=True)
def random_lit_place(generator: torch.Generator, clear_radius: float = 0.6) -> Scene:
    """A room, lobby or hall, furnished; y down, the rig at its origin; not yet exposed.

    A poster that is lit from behind, a panel of a ceiling or a screen is as bright as the sky in a window, and often as
    empty. It differs from one by its place: it lies in the wall or before it, and what is behind a pane does not. Some
    walls have panes, too, and most floors mirror what shines above them.
    """
    palette = Palette(generator)
    far, high = palette.choose(((5.0, (2.3, 3.5)), (9.0, (2.5, 5.0)), (20.0, (3.0, 9.0))))
    room = rooms.Room.drawn(palette, clear_radius, (clear_radius + 0.5, far), high)
    panes = {}
    for side in range(4):
        if palette.chance(0.2):
            wide, bottom = palette.log_uniform(0.5, 5.0), palette.choose((0.02, palette.uniform(0.4, 1.2)))
            top = bottom + palette.uniform(0.6, room.floor - room.ceiling)
            panes[side] = rooms.random_opening(room, side, wide, bottom, top)
    rooms.build_shell(room, panes)
    _finish(room)
    for side, opening in panes.items():
        add_panes(room, side, opening)
    _shine_above(room)
    for side in range(4):
        if side not in panes:
            _hang_boxes(room, side)
    for _ in range(palette.integer(0, 3)):
        _stand_box(room)
    rooms.furnish(room, palette.integer(2, 12))
    if palette.chance(0.5):
        rooms.decorate(room)
    lamps = lamps_near(palette, clear_radius, room.floor - room.ceiling, False) if palette.chance(0.7) else []
    ambient = palette.uniform(0.1, 0.4) if lamps else 1.0
    background = DAYLIGHT * palette.log_uniform(0.4, 3.0)
    return palette.scene(room.parts, lamps, ambient * torch.ones(3), background)


def _finish(room: rooms.Room) -> None:
    """Plain walls and a white ceiling for some; a floor that mirrors, strongly or hardly, for most."""
    palette = room.palette
    floor, roof = (part.material for part in room.parts[:2])
    if palette.chance(0.7):
        fraction = palette.log_uniform(0.05, 0.7)
        palette.materials[floor] = palette.materials[floor]._replace(mirror=fraction)
    if palette.chance(0.6):
        white = palette.color(0.7, 0.95, 0.05)
        palette.materials[roof] = palette.materials[roof]._replace(bright=white, dark=white)
    if palette.chance(0.5):
        for number in {part.material for part in room.parts} - {floor, roof}:
            bright = palette.color(0.4, 0.95, 0.3)
            palette.materials[number] = palette.materials[number]._replace(bright=bright, dark=bright)


def _face(palette: Palette, wide: float) -> int:
    """What shines: nothing but white, a tint that fades, or a picture; dim to dazzling."""
    glow, look = palette.log_uniform(0.6, 6.0), palette.uniform()
    if look < 0.35:
        return palette.glowing(palette.color(0.8, 1.0, 0.15), glow)
    if look < 0.75:
        return palette.photograph((wide * palette.uniform(0.5, 2.0),) * 2, emission=glow)
    contrast = palette.choose((0.05, palette.uniform(0.1, 0.8)))
    tile, bright = wide * palette.uniform(0.3, 2.0), palette.color(0.7, 1.0)
    number = palette.patterned(tile=tile, contrast=contrast, bright=bright)
    palette.materials[number] = palette.materials[number]._replace(emission=glow)
    return number


def _shine_above(room: rooms.Room) -> None:
    """Nothing, panels in a grid, or strips across, flush with the ceiling or hung below it; few or most of it."""
    palette = room.palette
    look = palette.choose(("none", "grid", "grid", "strips", "all"))
    if look == "none":
        return
    (x0, z0), (x1, z1) = room.low, room.high
    drop = 0.005 if palette.chance(0.6) else palette.uniform(0.02, 0.5)
    glow = palette.glowing(palette.color(0.85, 1.0, 0.1), palette.log_uniform(0.6, 6.0))
    y = room.ceiling + drop
    if look == "all":
        wide, deep = (palette.uniform(0.3, 1.0) * (high - low) / 2 for low, high in ((x0, x1), (z0, z1)))
        panels = [level((x0 + x1) / 2, y, (z0 + z1) / 2, wide, deep, glow)]
    else:
        step, wide = palette.uniform(1.0, 4.0), palette.log_uniform(0.08, 0.6)
        deep = wide if look == "grid" else (z1 - z0) / 2 * palette.uniform(0.5, 1.0)
        rows = max(1, int((z1 - z0) / step)) if look == "grid" else 1
        panels = [
            level(x0 + step * (k + 0.5), y, z0 + (z1 - z0) * (m + 0.5) / rows, wide, deep, glow)
            for k in range(max(1, int((x1 - x0) / step)))
            for m in range(rows)
        ]
    room.add(labelled(panels, "lamp"))


def _hang_boxes(room: rooms.Room, side: int) -> None:
    """Light boxes and screens in a row on a wall, in frames or without, thick or flat."""
    palette = room.palette
    yaw, x, z, start, end = room.sides()[side]
    count = palette.choose((0, 1, 1, 2, 4))
    if not count:
        return
    wide = min(palette.log_uniform(0.15, 1.6), 0.45 * (end - start) / count)
    high = min(palette.log_uniform(0.15, 1.5), 0.45 * (room.floor - room.ceiling))
    thick, edge = palette.log_uniform(0.01, 0.15), palette.choose((0.0, palette.uniform(0.01, 0.06)))
    down = palette.uniform(room.ceiling + high + 0.05, room.floor - high - 0.05)
    frame, alike = palette.metal(), _face(palette, 2 * wide) if palette.chance(0.4) else None
    for k in range(count):
        along = start + (end - start) * (k + palette.uniform(0.45, 0.55)) / count
        face = _face(palette, 2 * wide) if alike is None else alike
        board = [
            Part("box", (along, down, -thick / 2), (wide + edge, high + edge, thick / 2), frame),
            Part("rectangle", (along, down, -thick - 0.002), (wide, high, 1.0), face, casts_shadow=False),
        ]
        room.add(labelled(place(board, x, 0.0, z, yaw), "picture"))


def _stand_box(room: rooms.Room) -> None:
    """A machine or a pillar with a face that shines, or a sign that hangs from the ceiling."""
    palette = room.palette
    turn, away = palette.uniform(0, 2 * math.pi), 1 / palette.uniform(0.08, 1 / (room.clear + 0.5))
    x, z = away * math.sin(turn), away * math.cos(turn)
    if not (room.low[0] < x < room.high[0] and room.low[1] < z < room.high[1]):
        return
    wide, high = palette.log_uniform(0.15, 0.8), palette.uniform(0.3, 1.1)
    deep = palette.log_uniform(0.03, 0.5)
    hangs = palette.chance(0.3)
    if hangs:
        high, deep = high / 3, min(deep, 0.1)
    y = room.ceiling + high + palette.uniform(0.0, 0.3) if hangs else room.floor - high
    pieces = [Part("box", (0.0, y, 0.0), (wide, high, deep), palette.any_surface(1.0))]
    inner = palette.uniform(0.7, 1.0)
    for front in (-1, 1) if palette.chance(0.4) else (-1,):
        glow = _face(palette, 2 * wide)
        half = (inner * wide, inner * high, 1.0)
        pieces.append(Part("rectangle", (0.0, y, front * (deep + 0.002)), half, glow, casts_shadow=False))
    yaw = turn + palette.uniform(-0.8, 0.8)
    room.add(labelled(place(pieces, x, 0.0, z, yaw), "lamp"))
