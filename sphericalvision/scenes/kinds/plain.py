# SPDX-License-Identifier: Apache-2.0
"""Recipe for places with little to see: flat colours, faint or fine patterns, white ceilings, dazzling light."""

from __future__ import annotations

import math

import torch

from sphericalvision.scenes.kinds import rooms
from sphericalvision.scenes.kinds.palette import Palette
from sphericalvision.scenes.kinds.patchwork import lamps_near
from sphericalvision.scenes.registry import register_scene
from sphericalvision.scenes.rendering.primitives import Part
from sphericalvision.scenes.rendering.scene import Color, Scene

SHADED = 0.45
"""Share of places with lamps. In the others a surface of one colour looks alike from edge to edge."""
ROOFLESS = 0.2
"""Share of places under the sky."""
FAINTEST = (0.0, 0.04, 0.12, 0.4, 1.0)
"""What may be left of the contrast of all things in a place."""
GREY: Color = (0.5, 0.5, 0.5)


@register_scene("plain", other_sky=True)
def random_plain(generator: torch.Generator, clear_radius: float = 0.6) -> Scene:
    """A room, hall or yard, furnished, with bars and boards; y down, the rig at its origin; not yet exposed.

    What other people's models of rooms look like: furniture has flat colours, light is often even, and a white ceiling,
    or what a lamp shines on from near, is as bright as a sky. A plane is told from the void by its edges alone, and
    near things by their outlines.
    """
    palette = Palette(generator)
    far, high = palette.choose(((5.0, (2.2, 3.5)), (9.0, (2.5, 6.0)), (20.0, (3.0, 12.0))))
    room = rooms.Room.drawn(palette, clear_radius, (clear_radius + 0.4, far), high)
    _shell(room)
    finished = len(palette.materials)
    if palette.chance(0.6):
        rooms.furnish(room, palette.integer(3, 18))
    for _ in range(palette.integer(2, 12)):
        palette.choose((_block, _block, _bars, _board))(room)
    # The furniture of other kinds is grained; here most of it has lost that, to its own mean colour or towards grey.
    contrast, grey = palette.choose(FAINTEST), palette.chance(0.3)
    for number, material in enumerate(palette.materials[finished:], finished):
        bright = _mixed(GREY, material.bright, 0.15) if grey else material.bright
        fraction = contrast if palette.chance(0.8) else 1.0
        dark = _mixed(bright, material.dark, fraction)
        palette.materials[number] = material._replace(bright=bright, dark=dark)
    shaded = palette.chance(SHADED)
    if shaded and palette.chance(0.5):
        rooms.hang_lamps(room, palette.integer(1, 5))
    elif shaded:
        room.lamps = lamps_near(palette, clear_radius, room.floor - room.ceiling, False)
    ambient = torch.full((3,), palette.uniform(0.1, 0.5) if shaded else 1.0)
    background = torch.full((2, 3), palette.uniform(0.1, 1.0))
    return room.scene(ambient, background)


def _mixed(one: Color, other: Color, share: float) -> Color:
    """A colour at a share of the way from one to another."""
    return tuple(a + share * (b - a) for a, b in zip(one, other, strict=True))  # type: ignore[return-value]


def _surface(palette: Palette, white: float) -> int:
    """Plain, faint, finely repeated, or a photograph; with a chance of ``white`` nearly so."""
    tone = palette.color(0.75, 1.0, 0.1) if palette.chance(white) else palette.color(0.15, 1.0, 0.7)
    look = palette.uniform()
    if look < 0.45:
        return palette.patterned(("specks", "specks", "noise", "spectrum"), palette.log_uniform(0.3, 3.0),
                                 palette.choose((0.0, 0.02, 0.05, 0.15)), tone)  # fmt: skip
    if look < 0.75:
        names = ("specks", "checks", "tiles", "bricks", "weave", "stripes", "dots")
        return palette.patterned(names, palette.log_uniform(0.15, 2.0), palette.uniform(0.1, 0.6), tone)
    if look < 0.85:
        return palette.photograph(palette.log_uniform(0.5, 4.0))
    return palette.patterned(tile=palette.log_uniform(0.5, 4.0), contrast=palette.uniform(0.3, 1.0))


def _shell(room: rooms.Room) -> None:
    """Floor, walls that mostly are alike, with openings, and above a ceiling, mostly white, or nothing."""
    palette, white = room.palette, room.palette.choose((0.1, 0.5, 0.9))
    wall = _surface(palette, white)
    walls = {side: wall if palette.chance(0.75) else _surface(palette, white) for side in range(4)}
    holes, high = {}, room.floor - room.ceiling
    for side in range(4):
        if palette.chance(0.3):
            low = palette.choose((0.0, palette.uniform(0.3, 1.0)))
            wide = palette.log_uniform(0.7, 4.0)
            top = palette.uniform(0.6, 0.95) * high
            holes[side] = rooms.random_opening(room, side, wide, min(low, 0.5 * top), top)
    rooms.add_shell(room, _surface(palette, 0.2), _surface(palette, 0.8), walls, holes, casts=False)
    if palette.chance(ROOFLESS):
        room.parts = [part for part in room.parts if part.center[1] > room.ceiling + 1e-6]
    for side, hole in holes.items():
        if palette.chance(0.7):
            rooms.add_frame(room, side, hole, _surface(palette, 0.5), "door")


def _spot(room: rooms.Room) -> tuple[float, float]:
    """Somewhere in the room at even inverse distances, or on the far side of a wall."""
    palette, turn = room.palette, room.palette.uniform(0, 2 * math.pi)
    distance = 1 / palette.uniform(1 / max(*room.high, 3.0), 1 / (room.clear + 0.2))
    return distance * math.sin(turn), distance * math.cos(turn)


def _block(room: rooms.Room) -> None:
    """A box, ball or column of one colour, standing, hanging from the ceiling or in the air."""
    palette, (x, z) = room.palette, _spot(room)
    half = tuple(palette.log_uniform(0.04, 0.8) for _ in range(3))
    reach = (room.floor - room.ceiling) / 2
    size = (half[0], min(half[1] if palette.chance(0.7) else reach, reach), half[2])
    low, up = room.floor - size[1], room.ceiling + size[1]
    y = palette.choose((low, low, up, palette.uniform(up, low) if up < low else low))
    shape = palette.choose(("box", "box", "ellipsoid", "cylinder"))
    room.add([Part(shape, (x, y, z), size, _surface(palette, 0.3), yaw=palette.uniform(0, math.pi))])


def _bars(room: rooms.Room) -> None:
    """A lattice of thin bars, as of a railing, a shelf or a crate: the same again and again, near and far."""
    palette, (x, z) = room.palette, _spot(room)
    step, thick = palette.log_uniform(0.06, 0.5), palette.log_uniform(0.006, 0.03)
    count, rows = palette.integer(4, 12), palette.integer(1, 5)
    wide, high = step * count / 2, palette.uniform(0.4, 1.0) * (room.floor - room.ceiling) / 2
    y, yaw, material = room.floor - high, palette.uniform(0, math.pi), _surface(palette, 0.3)
    along, up = (math.cos(yaw), -math.sin(yaw)), palette.chance(0.8)
    bars = [Part("box", (x, y + high * (2 * k / rows - 1), z), (wide, thick, thick), material, yaw=yaw)
            for k in range(rows + 1)]  # fmt: skip
    for k in range(count + 1 if up else 0):
        off = step * k - wide
        center = (x + off * along[0], y, z + off * along[1])
        bars.append(Part("box", center, (thick, high, thick), material, yaw=yaw))
    room.add(bars)


def _board(room: rooms.Room) -> None:
    """A screen, sheet or partition that stands in the room or hangs in it."""
    palette, (x, z) = room.palette, _spot(room)
    half = (palette.log_uniform(0.2, 1.5), palette.log_uniform(0.15, 1.2), palette.log_uniform(0.005, 0.06))
    low = room.floor - half[1]
    y = low if palette.chance(0.5) else low - palette.uniform(0, 1) * max(0.0, low - half[1] - room.ceiling)
    face = palette.photograph(2 * half[0]) if palette.chance(0.3) else _surface(palette, 0.3)
    room.add([Part("box", (x, y, z), half, face, yaw=palette.uniform(0, math.pi))])
