# SPDX-License-Identifier: Apache-2.0
"""Recipe for half-open buildings: arches, columns, broken walls, stairs, beams and pipes before the sky."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import torch

from sphericalvision.scenes.kinds.palette import Palette, level
from sphericalvision.scenes.kinds.terrain import (
    CLUTTER,
    HERE,
    Point,
    beam,
    clutter,
    in_weather,
    off,
    weathered,
)
from sphericalvision.scenes.registry import register_scene
from sphericalvision.scenes.rendering.primitives import Part
from sphericalvision.scenes.rendering.scene import Scene

MASONRY = ("spectrum", "bricks", "tiles", "stripes", "cells", "wood", "checks")
GROUND = 200.0
"""Metres to the sides that the ground has."""
FALLEN = (((1, 1), (1.0, 5.0), 0.0, 1.5, (0.01, 0.05)), *CLUTTER[:2])
"""Beams that lean on something, blocks, rubble."""


@dataclass
class _Site:
    """Bays of ``step`` metres with walls ``high`` metres high and half ``thick`` metres thick, of a few materials."""

    palette: Palette
    step: float
    high: float
    thick: float
    materials: list[int]

    def material(self) -> int:
        """One of those that the site is built of."""
        return self.palette.choose(self.materials)


@register_scene("ruins", other_sky=True)
def random_ruins(generator: torch.Generator, clear_radius: float = 0.6) -> Scene:
    """A building of bays, partly roofed, partly fallen, with far towers; y down, the rig in it; not yet exposed."""
    palette = Palette(generator)
    step, floor = palette.uniform(2.5, 6.0), palette.log_uniform(clear_radius + 0.15, 3.0)
    stuff = [weathered(palette, step, MASONRY) for _ in range(palette.integer(2, 5))]
    high, thick = floor + palette.log_uniform(0.8, 5.0), palette.log_uniform(0.04, 0.4)
    site, parts = _Site(palette, step, high, thick, stuff), list[Part]()
    bays, walled, roofed = palette.integer(2, 5), palette.uniform(0.2, 0.7), palette.uniform(0.0, 0.8)
    x0, z0 = (palette.uniform(0.3 - bays, -0.3) for _ in range(2))
    for i in range(bays + 1):
        for k in range(bays + 1):
            corner = ((x0 + i) * step, floor, (z0 + k) * step)
            parts += _column(site, corner, high) if palette.chance(0.5) else []
            for inside, to in ((k < bays, 0.0), (i < bays, math.pi / 2)):
                if inside and palette.chance(walled):
                    parts += palette.choose((_wall, _wall, _arch))(site, corner, to)
            if i < bays and k < bays and palette.chance(roofed):
                parts += _roof(site, off(corner, step / 2**0.5, math.pi / 4))
    for _ in range(palette.integer(4, 14)):
        distance = 1 / palette.uniform(1 / 12.0, 1 / (clear_radius + 0.3))
        spot = off(HERE, distance, palette.uniform(0, 7), -floor)
        if palette.chance(0.3):
            parts += palette.choose((_stairs, _pipe))(site, spot)
        else:
            parts += clutter(palette, spot, *palette.choose(FALLEN))
    for _ in range(palette.integer(0, 5)):
        distance = palette.log_uniform(15.0, 150.0)
        tower = ((1, 3), (0.1 * distance, 0.4 * distance), 0.3, 0.0, (0.1, 0.5))
        parts += clutter(palette, off(HERE, distance, palette.uniform(0, 7), -floor), *tower)
    ground = level(0.0, floor, 0.0, GROUND, GROUND, weathered(palette, 2 * step, MASONRY))
    return in_weather(palette, [ground], parts, clear_radius, foggy=0.15)


def _wall(site: _Site, corner: Point, to: float) -> list[Part]:
    """Strips of wall, whole or broken off, some with a window or open below a lintel."""
    palette, material, count, parts = site.palette, site.material(), site.palette.integer(1, 4), []
    broken, wide = palette.chance(0.5), site.step / count
    spans = [[(0.0, 1.0)], [(0.0, 0.35), (0.75, 1.0)], [(0.8, 1.0)]]
    for k in range(count):
        top = site.high * (palette.uniform(0.15, 1.0) if broken else 1.0)
        for low, up in palette.choose(spans) if count > 1 else spans[0]:
            center = off(corner, (k + 0.5) * wide, to, (low + up) / 2 * top)
            parts.append(Part("box", center, (site.thick, (up - low) / 2 * top, wide / 2), material, yaw=to))
    return parts


def _arch(site: _Site, corner: Point, to: float) -> list[Part]:
    """A flat, round or pointed arch on two columns."""
    palette, material, pieces = site.palette, site.material(), site.palette.integer(5, 9)
    foot, rise = palette.uniform(0.3, 0.9) * site.high, palette.uniform(0.2, 0.7) * site.step
    turns, side = [math.pi * k / pieces for k in range(pieces + 1)], to + math.pi / 2
    line = [off(corner, site.step * (0.5 - 0.5 * math.cos(a)), to, foot + rise * math.sin(a)) for a in turns]
    beams = [beam(a, b, (site.thick, 0.7 * site.thick), material, to=side) for a, b in pairwise(line)]
    return beams + _column(site, corner, foot) + _column(site, off(corner, site.step, to), foot)


def _column(site: _Site, foot: Point, high: float) -> list[Part]:
    """A column with a foot and a head, or a stump of one."""
    whole, material, thick = site.palette.chance(0.8), site.material(), site.thick
    high *= 1.0 if whole else site.palette.uniform(0.1, 0.8)
    shape, ends = site.palette.choose(("cylinder", "box")), (0.05, high)[: 1 + whole]
    pieces = [Part("box", off(foot, 0, 0, up), (1.6 * thick, 0.08, 1.6 * thick), material) for up in ends]
    return [*pieces, beam(foot, off(foot, 0, 0, high), (1.2 * thick, 1.2 * thick), material, shape, to=0.0)]


def _roof(site: _Site, middle: Point) -> list[Part]:
    """A slab over a bay, or beams with the sky between them; at times a platform below."""
    palette, material, half, parts = site.palette, site.material(), site.step / 2, []
    if palette.chance(0.3):
        parts.append(Part("box", middle, (half, palette.uniform(0.05, 0.4), half), site.material()))
    count = palette.choose((1, 1, 2, 3, 5))
    wide = half if count == 1 else palette.log_uniform(0.03, 0.2)
    for k in range(count):
        at = off(middle, ((k + 0.5) / count - 0.5) * site.step, math.pi / 2, site.high + 0.1)
        parts.append(Part("box", at, (wide, 0.1, half), material))
    return parts


def _stairs(site: _Site, foot: Point) -> list[Part]:
    """Steps that lead up to nowhere."""
    palette, to, material, parts = site.palette, site.palette.uniform(0, 7), site.material(), []
    wide, deep, rise = palette.uniform(0.4, 1.5), palette.uniform(0.2, 0.4), palette.uniform(0.06, 0.12)
    for k in range(1, palette.integer(5, 13)):
        half = k * rise if palette.chance(0.9) else 0.03
        center = off(foot, k * deep, to, 2 * k * rise - half)
        parts.append(Part("box", center, (wide, half, deep / 2), material, yaw=to))
    return parts


def _pipe(site: _Site, spot: Point) -> list[Part]:
    """A pipe or cable that turns at right angles, along walls and through the air."""
    palette, thick, material = site.palette, site.palette.log_uniform(0.01, 0.15), site.material()
    line = [off(spot, 0, 0, palette.uniform(0.1, 1.0) * site.high)]
    for _ in range(palette.integer(2, 6)):
        to, reach, aloft = math.pi / 2 * palette.integer(0, 3), palette.uniform(0.5, 4.0), palette.chance(0.3)
        line.append(off(line[-1], 0.0 if aloft else reach, to, 0.3 * reach if aloft else 0.0))
    elbows = [Part("ellipsoid", b, (1.2 * thick, 1.2 * thick, 1.2 * thick), material) for b in line]
    return elbows + [beam(a, b, (thick, thick), material, "cylinder") for a, b in pairwise(line)]
