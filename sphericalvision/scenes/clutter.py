# SPDX-License-Identifier: Apache-2.0
"""Clutter around a rig, in any scene: people, screens of thin bars, chairs and tables, dark lacquer on legs."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.scenes.kinds.furniture import (
    Maker,
    chair,
    footprint_radius,
    place,
    plant,
    rack,
    stool,
    table,
)
from sphericalvision.scenes.kinds.palette import Palette
from sphericalvision.scenes.rendering.primitives import Part, pack
from sphericalvision.scenes.rendering.raycast import trace
from sphericalvision.scenes.rendering.scene import Scene, pack_materials

_DEEPEST, _FARTHEST = 2.5, 6.0
"""Metres below the rig and around it beyond which no floor and no room is looked for; things hang there."""


def _person(palette: Palette) -> list[Part]:
    """Somebody who stands: legs, a body, arms and a head."""
    tall, wide = palette.uniform(1.0, 1.9), palette.uniform(0.16, 0.25)
    trousers, shirt, skin = palette.paint(), palette.any_surface(0.4), palette.paint()
    high, apart = 0.24 * tall, palette.uniform(0.08, 0.2)
    leg, arm = (0.07, high, 0.08), (0.045, 0.2 * tall, 0.05)
    pieces = [
        Part("cylinder", (side * apart, -high, 0), leg, trousers, yaw=side * palette.uniform(0, 0.5))
        for side in (-1, 1)
    ]
    pieces.append(Part("ellipsoid", (0, -0.67 * tall, 0), (wide, 0.22 * tall, 0.6 * wide), shirt))
    for side in (-1, 1):
        shoulder = (side * (wide + 0.03), -(0.62 + palette.uniform(-0.1, 0.15)) * tall, 0)
        pieces.append(Part("cylinder", shoulder, arm, shirt))
    return [*pieces, Part("ellipsoid", (0, -0.94 * tall, 0), (0.085, 0.065 * tall, 0.1), skin)]


def _screen(palette: Palette) -> list[Part]:
    """Thin bars side by side, upright or level, between two posts."""
    x, height, thick = palette.uniform(0.4, 1.4), palette.uniform(0.8, 2.4), palette.log_uniform(0.006, 0.03)
    material = palette.metal() if palette.chance(0.6) else palette.any_surface(0.5)
    spacing = palette.log_uniform(2, 8) * 2 * thick
    upright, shape = palette.chance(0.7), palette.choose(("box", "cylinder"))
    length = 2 * x if upright else height
    bars = max(2, min(40, round(length / spacing)))
    places = [(k + 0.5) / bars for k in range(bars)]
    if upright:
        pieces = [
            Part(shape, ((2 * p - 1) * x, -height / 2, 0), (thick, height / 2, thick), material)
            for p in places
        ]
        ends = [Part("box", (0, -h, 0), (x, thick, 1.2 * thick), material) for h in (0.05, height)]
    else:
        pieces = [Part("box", (0, -p * height, 0), (x, thick, thick), material) for p in places]
        ends = [
            Part(shape, (s * x, -height / 2, 0), (1.5 * thick, height / 2, 1.5 * thick), material)
            for s in (-1, 1)
        ]
    return pieces + ends


def _lacquer(palette: Palette) -> list[Part]:
    """A dark or glossy body on thin legs, as a piano or a trolley."""
    x, z, deep, top = (palette.uniform(*r) for r in ((0.3, 0.8), (0.25, 0.8), (0.08, 0.25), (0.7, 1.1)))
    gloss = palette.patterned(("noise",), 1.0, 0.3, palette.color(0.01, 0.15, 0.4), palette.uniform(0, 0.25))
    legs = [(sx * (x - 0.06), sz * (z - 0.06)) for sx in (-1, 1) for sz in (-1, 1)]
    under, thin = (top - 2 * deep) / 2, palette.uniform(0.015, 0.05)
    return [
        Part("box", (0, deep - top, 0), (x, deep, z), gloss),
        *(Part("box", (lx, -under, lz), (thin, under, thin), gloss) for lx, lz in legs),
    ]


_MAKERS: tuple[Maker, ...] = (
    _person, _person, _screen, _screen, _screen, chair, chair, table, stool, _lacquer, rack, plant,
)  # fmt: skip
_MOST_CHAIRS = 4


@torch.no_grad()
def with_clutter(
    scene: Scene,
    center: Float[Tensor, " 3"],
    generator: torch.Generator,
    clear_radius: float = 0.6,
    scale: float = 1.0,
) -> Scene:
    """Stand up to twelve things on the floor around a rig, before what the scene has there.

    Where no floor is found below, or no wall around, they stand 1.5 m below the rig in mid-air.

    Args:
        scene: built around ``center``.
        center: ``(3,)`` of the rig, metres.
        generator: source of every random choice.
        clear_radius: free space around the rig before scaling, metres.
        scale: of the scene's lengths.

    Examples:
        >>> from sphericalvision.scenes import make_scene
        >>> room = make_scene("bare", seed=1)
        >>> len(with_clutter(room, torch.zeros(3), torch.Generator().manual_seed(1)).primitives) > len(room.primitives)
        True
    """
    palette = Palette(generator)
    start = center.cpu().float()

    def free(x: float, y: float, z: float, towards: tuple[float, float, float]) -> float:
        """Metres of natural size until something comes."""
        origin = start + scale * torch.tensor([x, y, z])
        return trace(scene.primitives, origin, torch.tensor([towards])).distance.item() / scale

    parts: list[Part] = []
    for _ in range(palette.integer(3, 9)):
        maker = palette.choose(_MAKERS)
        pieces = maker(palette)
        for _ in range(palette.integer(1, _MOST_CHAIRS) if maker is chair else 1):
            angle, yaw = palette.uniform(0, 2 * math.pi), palette.uniform(0, 2 * math.pi)
            ahead = (math.sin(angle), 0.0, math.cos(angle))
            room = min(free(0, 0, 0, ahead), free(0, 0.5, 0, ahead), _FARTHEST)
            reach = palette.log_uniform(0.15, max(0.2, room - footprint_radius(pieces)))
            x, z = reach * ahead[0], reach * ahead[2]
            floor = free(x, 0, z, (0.0, 1.0, 0.0))
            placed = place(
                pieces, x, floor if floor < _DEEPEST else 1.5, z, angle if maker is _screen else yaw
            )
            if pack(placed).distance_from(torch.zeros(3)).min() > clear_radius:
                parts += placed
    if not parts:
        return scene
    materials = pack_materials(palette.materials)
    materials = replace(materials, texture_from_surface=materials.texture_from_surface / scale)
    return scene.joined(pack(parts).scaled(scale).transformed(translation=start), materials)
