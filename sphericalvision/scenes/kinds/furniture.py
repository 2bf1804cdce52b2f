# SPDX-License-Identifier: Apache-2.0
"""Furniture for rendered rooms.

Every maker returns parts that stand on the floor at the origin of their own frame (y down, so that heights
are negative) and face +z; `place` puts them into the room.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from sphericalvision.scenes.kinds.labels import labelled
from sphericalvision.scenes.kinds.palette import Palette
from sphericalvision.scenes.rendering.primitives import Part, Vector

Maker = Callable[[Palette], list[Part]]


def moved(point: Vector, x: float, y: float, z: float, yaw: float) -> Vector:
    """A point turned by ``yaw`` about the vertical, then moved."""
    sin, cos = math.sin(yaw), math.cos(yaw)
    return x + cos * point[0] + sin * point[2], y + point[1], z - sin * point[0] + cos * point[2]


def place(parts: list[Part], x: float, y: float, z: float, yaw: float) -> list[Part]:
    """Parts turned by ``yaw`` about the vertical, then moved."""
    return [replace(part, center=moved(part.center, x, y, z, yaw), yaw=part.yaw + yaw) for part in parts]


def footprint_radius(parts: list[Part]) -> float:
    """Radius in metres of the circle around the origin that holds the parts, seen from above."""
    return max(math.hypot(p.center[0], p.center[2]) + math.hypot(p.half[0], p.half[2]) for p in parts)


def _slab(material: int, x: float, top: float, z: float, half: tuple[float, float, float]) -> Part:
    """A box whose upper side is ``top`` metres above the floor."""
    return Part("box", (x, half[1] - top, z), half, material)


def _legs(palette: Palette, material: int, x: float, z: float, height: float, thickness: float) -> list[Part]:
    shape = palette.choose(("box", "cylinder"))
    half = (thickness, height / 2, thickness)
    return [Part(shape, (sx * x, -height / 2, sz * z), half, material) for sx in (-1, 1) for sz in (-1, 1)]


def _ornament(palette: Palette, x: float, top: float, z: float, size: float = 0.12) -> list[Part]:
    """Something small that stands on a surface ``top`` metres above the floor."""
    shape = palette.choose(("box", "ellipsoid", "cylinder"))
    half = (palette.uniform(0.3, 1) * size, palette.uniform(0.3, 1.3) * size, palette.uniform(0.3, 1) * size)
    material = palette.any_surface(0.3)
    return [Part(shape, (x, -top - half[1] - 0.002, z), half, material, yaw=palette.uniform(0, 6.3))]


def table(palette: Palette) -> list[Part]:
    """A table with four legs and something on it."""
    x, z, height = palette.uniform(0.3, 0.9), palette.uniform(0.3, 0.5), palette.uniform(0.4, 0.85)
    top, leg = palette.any_surface(), palette.metal()
    pieces = [
        _slab(top, 0, height, 0, (x, 0.02, z)),
        *_legs(palette, leg, x - 0.05, z - 0.05, height - 0.04, 0.025),
    ]
    for _ in range(palette.integer(0, 3)):
        spot = palette.uniform(-0.8, 0.8) * x, palette.uniform(-0.7, 0.7) * z
        pieces += _ornament(palette, spot[0], height, spot[1])
    return pieces


def chair(palette: Palette) -> list[Part]:
    """A chair with a slatted or solid back."""
    material, leg = palette.any_surface(0.5), palette.metal()
    height, half = palette.uniform(0.4, 0.5), palette.uniform(0.19, 0.25)
    pieces = [
        _slab(material, 0, height, 0, (half, 0.025, half)),
        *_legs(palette, leg, half - 0.03, half - 0.03, height - 0.05, 0.016),
    ]
    back = palette.uniform(0.35, 0.6)
    if palette.chance(0.5):
        pieces.append(_slab(material, 0, height + back, -half, (half, back / 2, 0.015)))
    else:
        bars = palette.integer(3, 5)
        step = 2 * (half - 0.02) / (bars - 1)
        posts, thin = [(k * step - half + 0.02) for k in range(bars)], (0.012, back / 2, 0.012)
        pieces += [Part("cylinder", (x, -height - back / 2, -half), thin, leg) for x in posts]
        pieces.append(_slab(material, 0, height + back + 0.06, -half, (half, 0.04, 0.015)))
    return pieces


def stool(palette: Palette) -> list[Part]:
    """A round stool or side table on one foot."""
    radius, height = palette.uniform(0.15, 0.35), palette.uniform(0.4, 0.8)
    top, foot = palette.any_surface(0.5), palette.metal()
    return [
        Part("cylinder", (0, -height + 0.02, 0), (radius, 0.02, radius), top),
        Part("cylinder", (0, -height / 2, 0), (0.025, height / 2 - 0.04, 0.025), foot),
        Part("cylinder", (0, -0.015, 0), (0.7 * radius, 0.015, 0.7 * radius), foot),
        *(_ornament(palette, 0, height, 0) if palette.chance(0.5) else []),
    ]


def shelf(palette: Palette) -> list[Part]:
    """Open shelves with books and ornaments."""
    x, depth, height = palette.uniform(0.3, 0.8), palette.uniform(0.12, 0.2), palette.uniform(0.9, 2.1)
    frame, boards = palette.wood() if palette.chance(0.6) else palette.paint(), palette.integer(2, 4)
    pieces = [Part("box", (s * x, -height / 2, 0), (0.015, height / 2, depth), frame) for s in (-1, 1)]
    pieces.append(Part("box", (0, -height / 2, -depth), (x, height / 2, 0.008), frame))
    for k in range(boards + 1):
        top = 0.05 + (height - 0.06) * k / boards
        pieces.append(_slab(frame, 0, top, 0.005, (x - 0.016, 0.012, depth - 0.01)))
        if k < boards:
            width, tall = palette.uniform(0.2, 0.8) * x, palette.uniform(0.3, 0.75) * height / boards
            center = palette.uniform(-1, 1) * (x - width - 0.03)
            striped = palette.chance(0.6)
            books = (
                palette.patterned(("stripes", "mosaic"), 0.35, 0.9) if striped else palette.photograph(0.4)
            )
            pieces.append(_slab(books, center, top + tall, 0.0, (width, tall / 2, depth * 0.7)))
    return pieces


def cabinet(palette: Palette) -> list[Part]:
    """A chest or wardrobe, its doors a little proud, with things on top."""
    x, depth, height = palette.uniform(0.25, 0.8), palette.uniform(0.2, 0.32), palette.uniform(0.5, 2.1)
    body, door, knob = palette.any_surface(1.2), palette.any_surface(0.8), palette.metal()
    pieces = [_slab(body, 0, height, 0, (x, height / 2 - 0.02, depth))]
    for side in (-1, 1):
        leaf = (x / 2 - 0.02, height / 2 - 0.08, 0.015)
        pieces.append(_slab(door, side * x / 2, height - 0.06, depth, leaf))
        pieces.append(Part("ellipsoid", (side * 0.06, -height / 2, depth + 0.035), (0.02, 0.02, 0.02), knob))
    for _ in range(palette.integer(0, 2)):
        pieces += _ornament(palette, palette.uniform(-0.7, 0.7) * x, height, 0, 0.16)
    return pieces


def sofa(palette: Palette) -> list[Part]:
    """A sofa or armchair with cushions."""
    x, z = palette.uniform(0.4, 1.1), palette.uniform(0.38, 0.48)
    cloth, cushion = palette.any_surface(0.8), palette.any_surface(0.5)
    pieces = [
        _slab(cloth, 0, 0.42, 0, (x, 0.17, z)),
        _slab(cloth, 0, palette.uniform(0.7, 0.95), 0.1 - z, (x, 0.3, 0.1)),
        *[_slab(cloth, side * (x - 0.08), 0.6, 0, (0.08, 0.25, z)) for side in (-1, 1)],
    ]
    spots = [palette.uniform(-0.6, 0.6) * x for _ in range(palette.integer(0, 2))]
    return pieces + [Part("ellipsoid", (s, -0.56, -0.1), (0.2, 0.15, 0.1), cushion) for s in spots]


def bed(palette: Palette) -> list[Part]:
    """A bed with a headboard and a pillow."""
    x, z = palette.uniform(0.45, 0.8), palette.uniform(0.95, 1.05)
    frame, cover, pillow = palette.wood(), palette.any_surface(1.0), palette.paint()
    return [
        _slab(frame, 0, 0.28, 0, (x, 0.1, z)),
        _slab(cover, 0, 0.48, 0.04, (x - 0.03, 0.1, z - 0.06)),
        _slab(frame, 0, palette.uniform(0.8, 1.2), -z, (x, 0.35, 0.03)),
        Part("ellipsoid", (0, -0.52, 0.25 - z), (0.6 * x, 0.09, 0.2), pillow),
    ]


def floor_lamp(palette: Palette) -> list[Part]:
    """A thin pole with a shade."""
    height, radius = palette.uniform(1.2, 1.8), palette.uniform(0.1, 0.22)
    metal, shade = palette.metal(), palette.any_surface(0.4)
    return [
        Part("cylinder", (0, -0.015, 0), (0.14, 0.015, 0.14), metal),
        Part("cylinder", (0, -height / 2, 0), (0.012, height / 2, 0.012), metal),
        Part(palette.choose(("cylinder", "ellipsoid")), (0, -height, 0), (radius, 0.12, radius), shade),
    ]


def plant(palette: Palette) -> list[Part]:
    """A pot with a thin stem and leaves."""
    height, radius = palette.uniform(0.6, 1.7), palette.uniform(0.1, 0.2)
    pot = palette.any_surface(0.4)
    leaf = palette.patterned(
        ("noise", "stripes", "marble"), 0.3, 1.0, (palette.uniform(0.1, 0.5), palette.uniform(0.4, 0.8), 0.1)
    )
    pieces = [
        Part("cylinder", (0, -radius, 0), (radius, radius, radius), pot),
        Part("cylinder", (0, -height / 2, 0), (0.012, height / 2, 0.012), palette.wood()),
    ]
    for _ in range(palette.integer(3, 7)):
        angle, reach = palette.uniform(0, 2 * math.pi), palette.uniform(0.05, 0.22)
        center = (reach * math.sin(angle), -height + palette.uniform(-0.2, 0.3), reach * math.cos(angle))
        half = (palette.uniform(0.05, 0.16), palette.uniform(0.02, 0.12), palette.uniform(0.05, 0.18))
        pieces.append(Part("ellipsoid", center, half, leaf, yaw=angle))
    return pieces


def column(palette: Palette) -> list[Part]:
    """A thin or thick post from the floor far up."""
    radius, material = palette.log_uniform(0.015, 0.18), palette.any_surface(0.6)
    return [Part(palette.choose(("cylinder", "box")), (0, -3.0, 0), (radius, 3.0, radius), material)]


def stack(palette: Palette) -> list[Part]:
    """Boxes on top of each other, each turned a little."""
    parts, top = [], 0.0
    for _ in range(palette.integer(1, 4)):
        half = (palette.uniform(0.12, 0.3), palette.uniform(0.08, 0.22), palette.uniform(0.12, 0.3))
        parts.append(
            Part("box", (palette.uniform(-0.05, 0.05), -top - half[1], palette.uniform(-0.05, 0.05)), half,
                 palette.any_surface(0.6), yaw=palette.uniform(-0.5, 0.5))
        )  # fmt: skip
        top += 2 * half[1] + 0.001
    return parts


def ball(palette: Palette) -> list[Part]:
    """A ball or an egg on the floor."""
    radius, flat, skin = palette.uniform(0.1, 0.35), palette.uniform(0.7, 1.0), palette.any_surface(0.6)
    return [Part("ellipsoid", (0, -radius * flat, 0), (radius, radius * flat, radius), skin)]


def rack(palette: Palette) -> list[Part]:
    """A rail of thin bars: a clothes rack, a banister or a ladder."""
    x, height, material = palette.uniform(0.3, 0.8), palette.uniform(0.8, 1.9), palette.metal()
    thick, bars = palette.uniform(0.008, 0.025), palette.integer(2, 6)
    pieces = [Part("box", (0, thick - h, 0), (x, thick, thick), material) for h in (height, 0.12)]
    posts, half = [x * (2 * k / (bars - 1) - 1) for k in range(bars)], (thick, height / 2, thick)
    return pieces + [Part("cylinder", (p, -height / 2, 0), half, material) for p in posts]


#: Makers for the middle of a room, and for places along its walls.
FREE_STANDING: tuple[Maker, ...] = (
    table, chair, chair, stool, floor_lamp, plant, column, stack, ball, rack, sofa,
)  # fmt: skip
AGAINST_WALLS: tuple[Maker, ...] = (shelf, shelf, cabinet, cabinet, sofa, bed, table, plant, floor_lamp, rack)

#: What furniture is to somebody who labels pictures; makers that are not here make something "other".
NAMES: dict[Maker, str] = {
    table: "table",
    stool: "seat",
    chair: "seat",
    sofa: "seat",
    shelf: "storage",
    cabinet: "storage",
    bed: "bed",
    floor_lamp: "lamp",
    plant: "plant",
    column: "wall",
}


def make_piece(maker: Maker, palette: Palette) -> list[Part]:
    """A piece of furniture, labelled."""
    return labelled(maker(palette), NAMES.get(maker, "other"))
