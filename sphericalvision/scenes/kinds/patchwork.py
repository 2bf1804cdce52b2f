# SPDX-License-Identifier: Apache-2.0
"""Recipe for plain shapes under arbitrary pictures, seen from any height: what meshes of other people look like."""

from __future__ import annotations

import math

import torch

from sphericalvision.scenes.kinds.furniture import footprint_radius, place
from sphericalvision.scenes.kinds.palette import Palette, level
from sphericalvision.scenes.kinds.rooms import Room, wall_piece
from sphericalvision.scenes.registry import register_scene
from sphericalvision.scenes.rendering.primitives import Part
from sphericalvision.scenes.rendering.scene import Lamp, Scene

OPEN = 0.4
"""Share of places without walls and ceiling."""
LAMPLESS = 0.5
"""Share of places in even light, as meshes have it whose light is in their textures."""
GROUND = 120.0
"""Metres to the sides that the ground of an open place has."""


@register_scene("patchwork")
def random_patchwork(generator: torch.Generator, clear_radius: float = 0.6) -> Scene:
    """A box room, or open ground, with boxes, columns and balls; y down, the rig at the origin; not yet exposed.

    Nothing is as one would expect it: the rig is anywhere between floor and ceiling, or up to eight metres above the
    ground, and every surface shows a photograph or pattern of any size, or a plain colour. So depth can be told by
    nothing but parallax. In other scenes the ground is always as far below the rig as people hold one.
    """
    palette = Palette(generator)
    lampless, plain = palette.chance(LAMPLESS), palette.choose((0.05, 0.2, 0.8))
    is_open = palette.chance(OPEN)
    floor = palette.log_uniform(clear_radius + 0.1, 8.0 if is_open else 4.0)
    if is_open:
        sides = [GROUND] * 4
        top = palette.uniform(1.0, 10.0)
    else:
        sides = [palette.log_uniform(clear_radius + 0.2, 9.0) for _ in range(4)]
        top = palette.log_uniform(clear_radius + 0.1, 4.0)
    spot = Room(palette, (-sides[0], -sides[1]), (sides[2], sides[3]), floor, -top, clear_radius)
    _shell(spot, is_open, plain)
    for _ in range(palette.integer(4, 16)):
        _thing(spot, min(*sides, 15.0) if is_open else max(sides), plain)
    if is_open:
        for _ in range(palette.integer(0, 8)):
            _block(spot, plain)
    lamps = [] if lampless else lamps_near(palette, clear_radius, spot.floor - spot.ceiling, is_open)
    ambient = torch.full((3,), 1.0 if lampless else palette.uniform(0.15, 0.5))
    return palette.scene(spot.parts, lamps, ambient)


def lamps_near(palette: Palette, clear: float, height: float, is_open: bool) -> list[Lamp]:
    """One or two lamps near the rig, as the corners of a place may be anywhere, and the sun where it is open.

    Args:
        palette: source of every random choice.
        clear: metres around the rig that are free.
        height: of the place, metres; the lamps' power suits it.
        is_open: to the sky.
    """
    power, near = 0.5 * height**2, 0.8 * clear
    lamps = []
    for _ in range(palette.integer(1, 2)):
        x, y, z = (palette.uniform(-near, near) for _ in range(3))
        lamps.append(Lamp((x, y, z), (power, power, power), reach=1.0))
    if not is_open:
        return lamps
    away, turn = 300.0, palette.uniform(0, 2 * math.pi)
    sun = (away * math.sin(turn), -away * palette.uniform(0.4, 2.0), away * math.cos(turn))
    light = 0.8 * away**2
    return [Lamp(sun, (light, light, light), reach=1.0)]


def any_picture(palette: Palette, plain: float, size: float) -> int:
    """A plain colour, a photograph or a pattern, repeated up to six times over ``size`` metres."""
    if palette.chance(plain):
        return palette.patterned(("noise",), palette.uniform(0.5, 3.0), palette.choose((0.0, 0.05, 0.3)))
    tile = size / palette.log_uniform(0.7, 6.0)
    if palette.chance(0.5):
        return palette.photograph((tile, tile * palette.log_uniform(0.6, 1.6)))
    return palette.patterned(tile=tile, contrast=palette.uniform(0.4, 1.0))


def _shell(spot: Room, is_open: bool, plain: float) -> None:
    """Floor, and unless the place is open, four walls, of which some are alike, and a ceiling."""
    palette = spot.palette
    (x0, z0), (x1, z1) = spot.low, spot.high
    x, z, wide, deep = (x0 + x1) / 2, (z0 + z1) / 2, (x1 - x0) / 2, (z1 - z0) / 2
    tiled = palette.log_uniform(0.7, 8.0) if is_open else 2 * max(wide, deep)
    ground = any_picture(palette, 0.3 * plain if is_open else plain, tiled)
    spot.parts.append(level(x, spot.floor, z, wide, deep, ground))
    if is_open:
        return
    above = any_picture(palette, max(plain, 0.4), tiled)
    spot.parts.append(level(x, spot.ceiling, z, wide, deep, above))
    alike = any_picture(palette, plain, 2 * max(wide, deep))
    for yaw, wx, wz, start, end in spot.sides():
        material = alike if palette.chance(0.5) else any_picture(palette, plain, end - start)
        extent = (start, end, spot.ceiling, spot.floor)
        spot.parts += wall_piece(material, yaw, wx, wz, extent, casts=False)


def _thing(spot: Room, far: float, plain: float) -> None:
    """A box, a ball or a column, on the floor or in mid-air, at even inverse distances."""
    palette = spot.palette
    distance = 1 / palette.uniform(1 / max(far, spot.clear + 0.5), 1 / (spot.clear + 0.2))
    turn, reach = palette.uniform(0, 2 * math.pi), spot.floor - spot.ceiling
    size = palette.log_uniform(0.1, 0.9)
    shape = palette.choose(("box", "box", "box", "ellipsoid", "cylinder"))
    wide, high, deep = (size * palette.uniform(0.4, 1.2) for _ in range(3))
    if palette.chance(0.2):
        wide = deep = palette.log_uniform(0.02, 0.2)
        high = reach * palette.uniform(0.2, 0.5)
    half = (wide, min(high, reach / 2), deep)
    x, z = distance * math.sin(turn), distance * math.cos(turn)
    (x0, z0), (x1, z1) = spot.low, spot.high
    if not (x0 < x < x1 and z0 < z < z1):
        return
    y = spot.floor - half[1]
    if palette.chance(0.3):
        y = palette.uniform(spot.ceiling + half[1], y)
    material = any_picture(palette, plain, 2 * max(half[0], half[1]))
    tipped = palette.rotation() if palette.chance(0.2) else None
    yaw = palette.uniform(0, math.pi)
    spot.add([Part(shape, (x, y, z), half, material, yaw=yaw, rotation=tipped)])


def _block(spot: Room, plain: float) -> None:
    """A block as large as a house."""
    palette = spot.palette
    wide, high, deep = (palette.uniform(1.0, 5.0) for _ in range(3))
    pieces = [Part("box", (0.0, -high, 0.0), (wide, high, deep), any_picture(palette, plain, 2 * wide))]
    away, turn = palette.log_uniform(4.0, 40.0) + footprint_radius(pieces), palette.uniform(0, 2 * math.pi)
    where = (away * math.sin(turn), spot.floor, away * math.cos(turn))
    spot.add(place(pieces, *where, palette.uniform(0, math.pi)))
