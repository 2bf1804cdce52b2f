# SPDX-License-Identifier: Apache-2.0
"""Recipe for caves and slopes: places where nothing is level or upright."""

from __future__ import annotations

import math

import torch

from sphericalvision.scenes.kinds.palette import Palette
from sphericalvision.scenes.kinds.patchwork import LAMPLESS, any_picture, lamps_near
from sphericalvision.scenes.registry import register_scene
from sphericalvision.scenes.rendering.primitives import Part, pack
from sphericalvision.scenes.rendering.scene import Scene

OPEN = 0.4
"""Share of slopes below the sky; the others are caves."""
STEEPEST = math.radians(40)
"""Of slopes."""
GROUND = 150.0
"""Metres to the sides that a slope has."""

Vector = tuple[float, float, float]


@register_scene("rough")
def random_rough_place(generator: torch.Generator, clear_radius: float = 0.6) -> Scene:
    """A cave, or a slope below the sky, with boulders and beams; y down, the rig at the origin; not yet exposed.

    A cave is what up to three hollow balls, boxes and cylinders have in common, each turned anyhow. In other scenes
    floors are level and walls upright, and a network learns to count on it; scans of terrain, tunnels and attics are
    not so, and rigs are not held level.
    """
    palette = Palette(generator)
    lampless, plain = palette.chance(LAMPLESS), palette.choose((0.05, 0.1, 0.5))
    is_open = palette.chance(OPEN)
    pieces = _slope(palette, clear_radius, plain) if is_open else _hollow(palette, clear_radius, plain)
    far = 20.0 if is_open else max(pieces[0].half)
    for _ in range(palette.integer(3, 18)):
        boulder = _boulder(palette, far, clear_radius, plain)
        if _clear(boulder, clear_radius):
            pieces.append(boulder)
    lamps = [] if lampless else lamps_near(palette, clear_radius, palette.uniform(2.0, 5.0), is_open)
    ambient = torch.full((3,), 1.0 if lampless else palette.uniform(0.15, 0.5))
    return palette.scene(pieces, lamps, ambient)


def _clear(part: Part, clear: float) -> bool:
    return pack([part]).distance_from(torch.zeros(3)).item() >= clear


def _hollow(palette: Palette, clear: float, plain: float) -> list[Part]:
    """One to three shapes around the origin; what is seen from inside is the nearest of their far sides."""
    pieces = []
    alike = any_picture(palette, plain, 6.0) if palette.chance(0.3) else None
    for _ in range(palette.integer(1, 3)):
        shape = palette.choose(("ellipsoid", "box", "cylinder"))
        half = tuple(palette.log_uniform(clear + 0.3, 9.0) for _ in range(3))
        # A point s of the way from the centre of a convex body to a point of its surface has a ball of (1 - s) times
        # the least half size around it that is inside: the body shrunk by 1 - s towards that point of the surface.
        fraction = palette.uniform() * (1 - (clear + 0.1) / min(half))
        offset = [palette.uniform(-1, 1) for _ in range(3)]
        reach = {
            "ellipsoid": math.hypot(*offset),
            "box": max(map(abs, offset)),
            "cylinder": max(math.hypot(offset[0], offset[2]), abs(offset[1])),
        }[shape]
        local = [fraction * a * h / reach for a, h in zip(offset, half, strict=True)]
        rotation = palette.rotation()
        x, y, z = (-sum(row[k] * c for row, c in zip(rotation, local, strict=True)) for k in range(3))
        material = any_picture(palette, plain, 2 * max(half)) if alike is None else alike
        size = (half[0], half[1], half[2])
        pieces.append(Part(shape, (x, y, z), size, material, rotation=rotation, casts_shadow=False))
    return pieces


def _slope(palette: Palette, clear: float, plain: float) -> list[Part]:
    """A tilted plane, and hills that come out of it."""
    steep, turn = palette.uniform(0, STEEPEST), palette.uniform(0, 2 * math.pi)
    below = palette.log_uniform(clear + 0.1, 6.0)
    sin, cos = math.sin(turn), math.cos(turn)
    up = (math.sin(steep) * cos, -math.cos(steep), math.sin(steep) * sin)
    along = (-sin, 0.0, cos)
    down = (
        up[1] * along[2] - up[2] * along[1],
        up[2] * along[0] - up[0] * along[2],
        up[0] * along[1] - up[1] * along[0],
    )
    frame = [list(along), list(down), list(up)]
    ground = any_picture(palette, 0.3 * plain, palette.log_uniform(0.7, 8.0))
    origin = (-below * up[0], -below * up[1], -below * up[2])
    pieces = [Part("rectangle", origin, (GROUND, GROUND, 1.0), ground, rotation=frame, casts_shadow=False)]
    for _ in range(palette.integer(0, 6)):
        away, side = palette.log_uniform(3.0, 60.0), palette.uniform(0, 2 * math.pi)
        wide, high, deep = away * palette.uniform(0.2, 0.8), away * palette.uniform(0.05, 0.4), away * 0.5
        a, b = away * math.cos(side), away * math.sin(side)
        x, y, z = (o + a * u + b * v for o, u, v in zip(origin, along, down, strict=True))
        material = ground if palette.chance(0.4) else any_picture(palette, plain, wide)
        hill = Part("ellipsoid", (x, y, z), (wide, deep, high), material, rotation=frame)
        if _clear(hill, clear):
            pieces.append(hill)
    return pieces


def _boulder(palette: Palette, far: float, clear: float, plain: float) -> Part:
    """A ball, block or long beam in any direction and attitude, at even inverse distances."""
    distance = 1 / palette.uniform(1 / max(far, clear + 0.6), 1 / (clear + 0.3))
    height, turn = palette.uniform(-1, 1), palette.uniform(0, 2 * math.pi)
    across = math.sqrt(1 - height**2)
    center = (distance * across * math.sin(turn), distance * height, distance * across * math.cos(turn))
    size = distance * palette.log_uniform(0.05, 0.6)
    shape = palette.choose(("ellipsoid", "ellipsoid", "box", "cylinder"))
    wide, high, deep = (size * palette.uniform(0.3, 1.0) for _ in range(3))
    if palette.chance(0.2):
        shape, wide, deep = palette.choose(("box", "cylinder")), 0.1 * size, 0.1 * size
        high = 3 * size
    material = any_picture(palette, plain, 2 * max(wide, high, deep))
    return Part(shape, center, (wide, high, deep), material, rotation=palette.rotation())
