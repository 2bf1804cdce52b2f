# SPDX-License-Identifier: Apache-2.0
"""Recipe for a place under the open sky: ground to the horizon, sun, houses, trees, posts and parked cars.

The sky is where rays hit nothing: infinitely far, inverse depth 0.
"""

from __future__ import annotations

import math

import torch

from sphericalvision.scenes.kinds.furniture import footprint_radius, place
from sphericalvision.scenes.kinds.palette import Palette, level
from sphericalvision.scenes.kinds.rooms import Room
from sphericalvision.scenes.registry import register_scene
from sphericalvision.scenes.rendering.primitives import Part
from sphericalvision.scenes.rendering.scene import Color, Lamp, Material, Scene
from sphericalvision.scenes.rendering.textures import PHOTOGRAPHS

#: Metres from the rig to where the ground ends, beyond what any hypothesis tells from infinity.
HORIZON = 500.0


@register_scene("skies", other_sky=True)
@register_scene("outdoors")
def random_outdoor_place(generator: torch.Generator, clear_radius: float = 0.6) -> Scene:
    """A street, yard or meadow with the rig at its origin, y down; not yet exposed (see `make_scene`)."""
    palette = Palette(generator)
    ground = palette.uniform(0.75, 1.8)
    spot = Room(palette, (-HORIZON, -HORIZON), (HORIZON, HORIZON), ground, -HORIZON, clear_radius)
    _ground(spot)
    for _ in range(palette.integer(2, 5)):
        _hill(spot)
    for _ in range(palette.integer(2, 6)):
        _stand(spot, _house(palette), 5.0, 40.0)
    for _ in range(palette.integer(0, 4)):
        _stand(spot, _car(palette), 1.2, 20.0)
    for _ in range(palette.integer(4, 14)):
        _stand(spot, _tree(palette), 1.5, 40.0)
    for _ in range(palette.integer(6, 16)):
        small = palette.choose((_post, _bush, _person, _bollard))
        _stand(spot, small(palette), clear_radius + 0.1, 15.0)
    cloudy = palette.uniform()
    zenith = torch.lerp(torch.tensor([0.2, 0.42, 0.95]), torch.tensor([0.65, 0.68, 0.72]), cloudy)
    haze = torch.lerp(torch.tensor([0.7, 0.8, 0.95]), torch.tensor([0.8, 0.8, 0.8]), cloudy)
    sun, background = _sun(palette, cloudy), torch.stack([zenith, haze]) * palette.uniform(0.9, 1.2)
    return palette.scene(spot.parts, [sun], ambient=0.3 * zenith + 0.12, background=background)


def _stand(spot: Room, parts: list[Part], nearest: float, farthest: float) -> None:
    """Stand something on the ground at a random spot if there is room for it, at even inverse distances."""
    palette, radius = spot.palette, footprint_radius(parts)
    angle = palette.uniform(0, 2 * math.pi)
    distance = radius + 1 / palette.uniform(1 / farthest, 1 / nearest)
    x, z = distance * math.sin(angle), distance * math.cos(angle)
    if any(math.hypot(x - cx, z - cz) < radius + other for cx, cz, other in spot.circles):
        return
    if spot.add(place(parts, x, spot.floor, z, palette.uniform(0, 2 * math.pi))):
        spot.circles.append((x, z, radius))


def _sun(palette: Palette, cloudy: float) -> Lamp:
    """A lamp so far away that its shadows are nearly parallel; weaker behind clouds."""
    height, angle = palette.uniform(0.35, 1.3), palette.uniform(0, 2 * math.pi)
    distance = 300.0
    across = distance * math.cos(height)
    power = (1 - 0.7 * cloudy) * 0.9 * distance**2
    position = (across * math.sin(angle), -distance * math.sin(height), across * math.cos(angle))
    return Lamp(position, (power, 0.95 * power, 0.85 * power), reach=1.0)


def _photograph(palette: Palette, name: str, tile: float, tint: Color) -> int:
    texture = PHOTOGRAPHS.index(name)
    return palette.add(Material(texture, (0.02, 0.02, 0.02), tint, (tile, tile), turn=palette.uniform(0, 3)))


def _ground(spot: Room) -> None:
    """Grass, gravel, asphalt or paving to the horizon, mostly with a road or path across it."""
    palette = spot.palette
    green = (palette.uniform(0.5, 0.9), palette.uniform(0.8, 1.0), palette.uniform(0.3, 0.5))
    kinds = (
        lambda: _photograph(palette, "grass.png", palette.uniform(1.5, 4.0), green),
        lambda: _photograph(palette, "gravel.png", palette.uniform(0.8, 2.0), palette.color(0.6, 1.0, 0.2)),
        lambda: palette.patterned(("noise",), palette.uniform(1, 3), 0.5, palette.color(0.2, 0.45, 0.1)),
        lambda: palette.patterned(
            ("tiles", "bricks"), palette.uniform(1.5, 3), 0.6, palette.color(0.4, 0.7, 0.2)
        ),
    )
    first = palette.integer(0, 3)
    # Nothing is below the ground, so it need not cast a shadow.
    spot.parts.append(level(0.0, spot.floor, 0.0, HORIZON, HORIZON, kinds[first]()))
    if palette.chance(0.7):
        wide, x = palette.uniform(1.0, 4.0), palette.uniform(-5.0, 5.0)
        road = Part("box", (x, spot.floor + 0.08, 0.0), (wide, 0.1, HORIZON), kinds[(first + 2) % 4]())
        spot.parts.append(road)


def _hill(spot: Room) -> None:
    """A wooded hill far away, most of it below the ground."""
    palette = spot.palette
    away, angle = palette.uniform(150.0, 350.0), palette.uniform(0, 2 * math.pi)
    green = (palette.uniform(0.1, 0.3), palette.uniform(0.25, 0.4), palette.uniform(0.1, 0.25))
    material = palette.patterned(("noise",), palette.uniform(20.0, 60.0), 0.7, green)
    half = (palette.uniform(40, 120), palette.uniform(10, 35), palette.uniform(40, 120))
    center = (away * math.sin(angle), spot.floor, away * math.cos(angle))
    spot.parts.append(Part("ellipsoid", center, half, material, yaw=angle, casts_shadow=False))


def _house(palette: Palette) -> list[Part]:
    """Walls with rows of windows and a door, under a flat roof."""
    x, z, height = palette.uniform(2.5, 8.0), palette.uniform(2.5, 6.0), palette.uniform(2.8, 12.0)
    tile, tone = palette.uniform(1, 2.5), palette.color(0.4, 0.9, 0.5)
    plaster = palette.patterned(("noise", "bricks"), tile, 0.4, tone)
    glass = palette.add(Material(0, (0.03, 0.04, 0.06), (0.03, 0.04, 0.06), mirror=0.4))
    frame, roof = palette.paint(), palette.any_surface(2.0)
    pieces = [
        Part("box", (0.0, -height / 2, 0.0), (x, height / 2, z), plaster),
        Part("box", (0.0, -height - 0.1, 0.0), (x + 0.3, 0.15, z + 0.3), roof),
        Part("box", (palette.uniform(-0.6, 0.6) * x, -1.05, z), (0.5, 1.05, 0.05), frame),
    ]
    wide, step = palette.uniform(0.35, 0.7), palette.uniform(1.6, 2.6)
    for storey in range(1, int(height / 2.8) + 1):
        y = -2.8 * storey + 1.1
        for k in range(int((2 * x - 0.8) / step)):
            across = -x + 0.9 + k * step
            for side in (-1, 1):
                sill = (across, y, side * z)
                pieces.append(Part("box", sill, (wide + 0.06, 0.66, 0.05), frame, casts_shadow=False))
                pane = (across, y, side * (z + 0.055))
                pieces.append(Part("rectangle", pane, (wide, 0.6, 1.0), glass, casts_shadow=False))
    return pieces


def _tree(palette: Palette) -> list[Part]:
    """A trunk and a crown of a few balls of leaves, or a slim conifer."""
    height, trunk = palette.uniform(2.5, 9.0), palette.wood()
    green = (palette.uniform(0.15, 0.5), palette.uniform(0.35, 0.65), palette.uniform(0.05, 0.2))
    leaves = palette.patterned(("noise", "dots"), palette.uniform(0.4, 1.0), 0.9, green)
    stem = 0.02 * height + 0.03
    pieces = [Part("cylinder", (0.0, -0.3 * height, 0.0), (stem, 0.3 * height, stem), trunk)]
    slim = palette.chance(0.3)
    for _ in range(palette.integer(2, 5)):
        size = (0.12 if slim else palette.uniform(0.15, 0.28)) * height
        half = (size, (0.35 if slim else 0.2) * height, size)
        side = 0.02 if slim else 0.1
        center = (palette.uniform(-side, side) * height, -0.7 * height, palette.uniform(-side, side) * height)
        pieces.append(Part("ellipsoid", center, half, leaves, yaw=palette.uniform(0, 3)))
    return pieces


def _car(palette: Palette) -> list[Part]:
    """A body, a cabin with dark windows, and four wheels."""
    paint = palette.patterned(("noise",), 1.0, 0.05, palette.color(0.1, 0.9, 0.9), mirror=0.15)
    glass = palette.add(Material(0, (0.02, 0.02, 0.03), (0.02, 0.02, 0.03), mirror=0.3))
    rubber = palette.patterned(("noise",), 0.3, 0.3, (0.04, 0.04, 0.04))
    long, wide = palette.uniform(1.7, 2.4), palette.uniform(0.75, 0.95)
    pieces = [
        Part("box", (0.0, -0.55, 0.0), (wide, 0.3, long), paint),
        Part("box", (0.0, -1.05, 0.1), (0.85 * wide, 0.24, 0.55 * long), glass),
        Part("box", (0.0, -1.31, 0.1), (0.8 * wide, 0.03, 0.5 * long), paint),
    ]
    wheels = [(side * wide, -0.32, 0.6 * end * long) for side in (-1, 1) for end in (-1, 1)]
    return pieces + [Part("ellipsoid", spot, (0.12, 0.32, 0.32), rubber) for spot in wheels]


def _post(palette: Palette) -> list[Part]:
    """A street lamp or a pole with a sign."""
    height, metal = palette.uniform(2.2, 5.0), palette.metal()
    pieces = [Part("cylinder", (0.0, -height / 2, 0.0), (0.04, height / 2, 0.04), metal)]
    if palette.chance(0.5):
        pieces.append(Part("box", (0.0, -height + 0.3, 0.05), (0.3, 0.3, 0.01), palette.photograph(0.6)))
    else:
        pieces.append(Part("ellipsoid", (0.0, -height, 0.3), (0.12, 0.06, 0.3), metal))
    return pieces


def _bush(palette: Palette) -> list[Part]:
    green = (palette.uniform(0.1, 0.4), palette.uniform(0.3, 0.6), palette.uniform(0.05, 0.2))
    leaves = palette.patterned(("noise", "dots"), 0.4, 0.9, green)
    size = palette.uniform(0.25, 0.7)
    return [
        Part(
            "ellipsoid",
            (palette.uniform(-0.3, 0.3) * size, -0.6 * size, palette.uniform(-0.3, 0.3) * size),
            (size * palette.uniform(0.6, 1), 0.7 * size, size * palette.uniform(0.6, 1)),
            leaves,
        )
        for _ in range(palette.integer(1, 3))
    ]


def _person(palette: Palette) -> list[Part]:
    """Legs, a trunk with arms, and a head."""
    trousers, coat = palette.any_surface(0.5), palette.any_surface(0.5)
    skin = palette.patterned(("noise",), 0.3, 0.2, (palette.uniform(0.3, 0.8), 0.4, 0.3))
    scale = palette.uniform(0.85, 1.1)
    pieces = [
        *(Part("cylinder", (s * 0.1, -0.42, 0.0), (0.07, 0.42, 0.08), trousers) for s in (-1, 1)),
        Part("ellipsoid", (0.0, -1.15, 0.0), (0.2, 0.36, 0.13), coat),
        *(Part("ellipsoid", (s * 0.23, -1.1, 0.0), (0.05, 0.32, 0.06), coat) for s in (-1, 1)),
        Part("ellipsoid", (0.0, -1.62, 0.0), (0.09, 0.12, 0.1), skin),
    ]
    return [_scaled(part, scale) for part in pieces]


def _bollard(palette: Palette) -> list[Part]:
    radius, height = palette.uniform(0.05, 0.15), palette.uniform(0.5, 1.0)
    material = palette.patterned(("stripes", "noise"), 0.5, 0.9)
    return [Part("cylinder", (0.0, -height / 2, 0.0), (radius, height / 2, radius), material)]


def _scaled(part: Part, factor: float) -> Part:
    x, y, z = (factor * value for value in part.center)
    a, b, c = (factor * value for value in part.half)
    return Part(part.shape, (x, y, z), (a, b, c), part.material)
