# SPDX-License-Identifier: Apache-2.0
"""Recipe for open country: uneven ground of all scales, clutter on it, ridges far away, fog at times, under any sky."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch.nn.functional import normalize

from sphericalvision.icosphere import Icosphere
from sphericalvision.scenes.kinds.furniture import place
from sphericalvision.scenes.kinds.palette import Palette
from sphericalvision.scenes.kinds.patchwork import any_picture, lamps_near
from sphericalvision.scenes.registry import register_scene
from sphericalvision.scenes.rendering.primitives import SHAPES, Part, pack
from sphericalvision.scenes.rendering.ray_packets import RayPackets, packed
from sphericalvision.scenes.rendering.raycast import first_hits, trace
from sphericalvision.scenes.rendering.scene import Scene

Point = tuple[float, float, float]

HERE: Point = (0.0, 0.0, 0.0)
GROUND, ABOVE = 300.0, 200.0
"""Metres to the sides that the ground has, and above everything, from where its height is looked up."""
CLUTTER = (
    ((1, 1), (0.2, 3.0), 0.0, 3.0, (0.2, 0.6)),  # a boulder
    ((6, 14), (0.1, 0.4), 4.0, 3.0, (0.05, 0.5)),  # leaves, chips, stones
    ((5, 10), (0.2, 1.5), 0.3, 0.6, (0.005, 0.04)),  # grass, reed
    ((5, 9), (0.6, 4.0), 0.0, 1.2, (0.005, 0.02)),  # branches of a bare shrub
    ((1, 1), (0.8, 9.0), 0.0, 0.2, (0.005, 0.05)),  # a trunk, pole or stump
)
"""Least and largest number of pieces, and length of each in metres; in lengths the spread of their feet, how far they
may lean, and least and largest half thickness."""


@register_scene("terrain", other_sky=True)
def random_terrain(generator: torch.Generator, clear_radius: float = 0.6) -> Scene:
    """Hills or rocks from decimetres to a hundred metres, with stones, plants, fences, wires and houses on them.

    Nothing is level. y is down, the rig at the origin; not yet exposed.
    """
    palette = Palette(generator)
    land = _land(palette)
    below = palette.log_uniform(clear_radius + 0.1, 6.0) - _on(land, [HERE])[0][1]
    land = place(land, 0.0, below, 0.0, 0.0)
    # The rig is above all of the land, but what is steep may still be near at its side. The plane never is.
    hit = trace(pack(land), torch.zeros(3), Icosphere(4).vertices)
    while near := set(hit.primitive[hit.distance < clear_radius + 0.05].tolist()):
        land = [part for number, part in enumerate(land) if number not in near]
        hit = trace(pack(land), torch.zeros(3), Icosphere(4).vertices)
    surfaces, some = _fence(palette, land), [palette.choose(CLUTTER) for _ in range(2)]
    for spot in _on(land, [_spot(palette, clear_radius) for _ in range(palette.integer(20, 45))]):
        if palette.chance(0.15):
            surfaces += _house(palette, spot)
        else:
            surfaces += clutter(palette, spot, *palette.choose(some if palette.chance(0.5) else CLUTTER))
    return in_weather(palette, land, surfaces, clear_radius, foggy=0.3)


def in_weather(palette: Palette, land: list[Part], parts: list[Part], clear: float, foggy: float) -> Scene:
    """The scene of land and what keeps off the rig: in sun, even light or that of lamps; some in fog."""
    light = palette.choose(("sun", "sun", "even", "even", "lamps"))
    lamps = [] if light == "even" else lamps_near(palette, clear, palette.uniform(1.5, 3.0), light == "sun")
    ambient = torch.full((3,), 1.0 if light == "even" else palette.uniform(0.15, 0.5))
    fog = 3 / palette.log_uniform(15.0, 200.0) if palette.chance(foggy) else 0.0
    keep = (pack(parts).distance_from(torch.zeros(3)) >= clear).tolist()
    pieces = land + [part for part, is_clear in zip(parts, keep, strict=True) if is_clear]
    return palette.scene(pieces, lamps, ambient, torch.full((2, 3), palette.uniform(0.1, 0.3)), fog)


def weathered(palette: Palette, size: float, names: tuple[str, ...] = ("spectrum", "cells", "noise")) -> int:
    """Mostly one of some patterns, repeated up to twelve times over ``size`` metres, or any picture."""
    if palette.chance(0.35):
        return any_picture(palette, 0.1, size)
    tile, bright = size / palette.log_uniform(1.0, 12.0), palette.color(0.4, 1.0, 0.5)
    return palette.patterned(names, tile, palette.uniform(0.6, 1.0), bright)


def off(start: Point, away: float, angle: float, up: float = 0.0) -> Point:
    """The point so many metres from another to a side, and so many higher."""
    return (start[0] + away * math.sin(angle), start[1] - up, start[2] + away * math.cos(angle))


def beam(
    start: Point, end: Point, half: tuple[float, float], material: int, shape: str = "box", to: float = 0.6
) -> Part:
    """Any shape stretched from one point to another; the first of its ``half`` sizes is towards the angle ``to``."""
    a, b, hint = torch.tensor([start, end, off(HERE, 1.0, to)], dtype=torch.float64)
    y = normalize(b - a, dim=0)
    x = normalize(hint - (hint @ y) * y, dim=0)
    frame = torch.stack([x, y, torch.linalg.cross(x, y)]).tolist()
    center = ((a + b) / 2).tolist()
    size = (half[0], math.dist(start, end) / 2, half[1])
    return Part(shape, (center[0], center[1], center[2]), size, material, rotation=frame)


def clutter(
    palette: Palette,
    spot: Point,
    pieces: tuple[int, int],
    lengths: tuple[float, float],
    spread: float,
    lean: float,
    slim: tuple[float, float],
) -> list[Part]:
    """Pieces of one shape around a spot, see `CLUTTER`."""
    long, material, shape = palette.log_uniform(*lengths), weathered(palette, 2.0), palette.choose(SHAPES)
    half, surfaces = long * palette.log_uniform(*slim), []
    for _ in range(palette.integer(*pieces)):
        foot = off(spot, palette.uniform(0, spread) * long, palette.uniform(0, 7), -0.1 * long)
        away, to = palette.uniform(0, lean) * long, palette.uniform(0, 7)
        tip = off(foot, away, to, palette.uniform(0.5, 1) * long)
        thick = (half * palette.uniform(0.3, 1.0), half * palette.uniform(0.3, 1.0))
        surfaces.append(beam(foot, tip, thick, material, shape, palette.uniform(0, 3)))
    return surfaces


def _land(palette: Palette) -> list[Part]:
    """A tilted plane through the origin, mounds and rocks of many sizes that come out of it, and ridges far away."""
    steep, turn, rocky = palette.uniform(0, 0.25), palette.uniform(0, 7), palette.choose((0.0, 0.3, 0.9))
    ground = [weathered(palette, palette.log_uniform(1.5, 20.0)) for _ in range(3)]
    start, end = (off(HERE, side * GROUND, turn, side * GROUND * steep) for side in (-1, 1))
    pieces = [beam(start, end, (GROUND, 1.0), ground[0], "rectangle", turn + math.pi / 2)]
    for number in range(palette.integer(20, 45)):
        far = number < 7
        distance = palette.log_uniform(12.0, 160.0) if far else palette.log_uniform(0.5, 40.0)
        long = (
            palette.uniform(0.2, 0.9) * distance if far else palette.log_uniform(0.15, 0.9) * (distance + 1)
        )
        wide, high = long * palette.uniform(0.3, 1.0), long * palette.uniform(0.05, 0.6 if far else 0.3)
        to, side = palette.uniform(0, 7), palette.uniform(0, 7)
        center = off(HERE, distance, to, distance * steep * math.cos(to - turn))
        start, end = (off(center, k * long, side, k * long * 0.2) for k in (-1, 1))
        material = palette.choose(ground) if palette.chance(0.8) else weathered(palette, long)
        shape = "box" if palette.chance(rocky) else "ellipsoid"
        pieces.append(beam(start, end, (wide, high), material, shape, side + math.pi / 2))
    return pieces


def _on(land: list[Part], spots: list[Point]) -> list[Point]:
    """Points of the land above or below some others."""
    origin = torch.tensor([(x, -ABOVE, z) for x, _, z in spots]).T.contiguous()
    down = torch.tensor([[0.0], [1.0], [0.0]]).expand_as(origin).contiguous()
    distance, _ = first_hits(pack(land), RayPackets(packed(origin), packed(down)))
    heights = (distance.flatten()[: len(spots)] - ABOVE).tolist()
    return [(x, y, z) for (x, _, z), y in zip(spots, heights, strict=True)]


def _spot(palette: Palette, clear: float) -> Point:
    """Somewhere around the rig, at even inverse distances."""
    return off(HERE, 1 / palette.uniform(1 / 60.0, 1 / (clear + 0.4)), palette.uniform(0, 7))


def _house(palette: Palette, spot: Point) -> list[Part]:
    """A block with doors and windows, mostly under a gabled roof; none near the rig."""
    if math.hypot(spot[0], spot[2]) < 6:
        return []
    wide, high, deep = (palette.uniform(1.0, 4.0) for _ in range(3))
    yaw, (wall, roof, pane) = palette.uniform(0, math.pi), [weathered(palette, 3.0) for _ in range(3)]
    pieces = [Part("box", off(spot, 0, 0, high - 1), (wide, high + 1, deep), wall, yaw=yaw)]
    if palette.chance(0.7):
        ridge, sides = off(spot, 0, 0, 2 * high + 0.6 * wide), (yaw - math.pi / 2, yaw + math.pi / 2)
        eaves = [off(spot, 1.15 * wide, side, 2 * high - 0.2) for side in sides]
        pieces += [beam(eave, ridge, (1.1 * deep, 0.06), roof, to=yaw) for eave in eaves]
    for _ in range(palette.integer(0, 5)):
        front = off(spot, deep, yaw + palette.choose((0.0, math.pi)), palette.uniform(0.3, 1.6) * high)
        center = off(front, palette.uniform(-0.7, 0.7) * wide, yaw + math.pi / 2)
        pieces.append(Part("box", center, (0.12 * wide, 0.2 * high, 0.05), pane, yaw=yaw))
    return pieces


def _fence(palette: Palette, land: list[Part]) -> list[Part]:
    """Posts in a row that follows the ground, with rails or wires from each to the next."""
    start, to, step = _spot(palette, 1.5), palette.uniform(0, 7), palette.log_uniform(1.0, 8.0)
    feet = _on(land, [off(start, k * step, to) for k in range(-4, 5)])
    high, thick = palette.uniform(0.8, 1.5) * step**0.5, palette.log_uniform(0.015, 0.08)
    material, thin = weathered(palette, 1.0), (0.4 * thick, 0.4 * thick)
    pieces = [beam(foot, off(foot, 0, 0, high), (thick, thick), material, "cylinder") for foot in feet]
    for share in (1.0, 0.6, 0.3)[: palette.integer(1, 3)]:
        ends = [off(foot, 0, 0, share * high) for foot in feet]
        pieces += [beam(a, b, thin, material, "cylinder") for a, b in pairwise(ends)]
    return pieces
