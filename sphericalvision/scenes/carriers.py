# SPDX-License-Identifier: Apache-2.0
"""What carries a rig and is in its view: a pole, a robot, a vehicle; in pictures, and as masks."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import check_choice
from sphericalvision.scenes.kinds.palette import Palette
from sphericalvision.scenes.rendering.primitives import Part, Primitives, pack
from sphericalvision.scenes.rendering.raycast import trace
from sphericalvision.scenes.rendering.scene import Scene, pack_materials

CARRIERS = ("pole", "robot", "vehicle")

DEEPEST = 2.0
"""Metres below the rig beyond which no floor is looked for."""
ABOUT_X = ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
"""Local axes of a cylinder that lies along x."""


class Carried(NamedTuple):
    """A scene with what carries the rig in it, and that body alone."""

    scene: Scene
    body: Primitives


def with_carrier(scene: Scene, kind: str, rig: CameraRig, seed: int = 0) -> Carried:
    """Put what carries a rig under it, down to the floor, if there is one within two metres.

    Args:
        scene: built around the rig's centre.
        kind: ``"pole"`` (a plate on a monopod), ``"robot"`` (a box with legs) or ``"vehicle"`` (the size of the rig,
            whose cameras stand at its corners, with wheels).
        rig: unbatched; its size is that of the body.
        seed: of materials and sizes.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.scenes import make_scene, ray_depth
        >>> rig, down = ring_rig(4), torch.tensor([0.0, 1.0, 0.0])
        >>> carried = with_carrier(make_scene("room", seed=0), "pole", rig)
        >>> bool(ray_depth(carried.scene, rig.center, down) < 0.1)
        True
    """
    check_choice("kind", kind, CARRIERS)
    palette = Palette(torch.Generator().manual_seed(seed))
    down = trace(scene.primitives, rig.center.cpu().float(), torch.tensor([[0.0, 1.0, 0.0]])).distance.item()
    floor = down if down < DEEPEST else 0.6
    sides = (rig.positions - rig.center).abs().amax(0).tolist()
    pieces = {"pole": _pole, "robot": _robot, "vehicle": _vehicle}[kind](palette, sides, floor)
    body = pack(pieces).transformed(translation=rig.center.cpu().float())
    return Carried(scene.joined(body, pack_materials(palette.materials)), body)


def carrier_masks(body: Primitives, rig: CameraRig) -> dict[str, Bool[Tensor, "h w"]]:
    """Return by camera name where its image ``(h, w)`` is free of the body: True is usable, as ``CameraRig`` has it."""
    masks = {}
    for (name, camera), pose in zip(rig.cameras.items(), rig.world_from_camera, strict=True):
        rays = camera.unproject(camera.pixel_grid()).directions.float()
        hit = trace(body, pose[:3, 3].float(), rays @ pose[:3, :3].T.float()).distance.isfinite()
        # Pixels that it covers in part
        around = torch.nn.functional.max_pool2d(hit[None].float(), 3, 1, 1)[0]
        masks[name] = around == 0
    return masks


def _pole(palette: Palette, sides: list[float], floor: float) -> list[Part]:
    """A plate that holds the cameras, on a thin tube."""
    plate = max(sides)
    metal = palette.metal()
    high = (floor - 0.08) / 2
    return [
        Part("cylinder", (0.0, 0.055, 0.0), (plate, 0.015, plate), metal),
        Part("cylinder", (0.0, 0.08 + high, 0.0), (0.02, high, 0.02), palette.metal()),
    ]


def _robot(palette: Palette, sides: list[float], floor: float) -> list[Part]:
    """A box below the cameras, on a column and a foot."""
    wide = 0.85 * max(sides)
    bottom = min(0.4, floor - 0.1)
    shell, dark = palette.any_surface(0.5), palette.metal()
    half = (bottom - 0.07) / 2
    column = (floor - bottom) / 2
    return [
        Part("box", (0.0, 0.07 + half, 0.0), (wide, half, 0.8 * wide), shell, yaw=palette.uniform(0, 6.3)),
        Part("cylinder", (0.0, bottom + column, 0.0), (0.06, column, 0.06), dark),
        Part("cylinder", (0.0, floor - 0.04, 0.0), (0.25, 0.03, 0.25), dark),
    ]


def _vehicle(palette: Palette, sides: list[float], floor: float) -> list[Part]:
    """A body between the cameras at its upper corners, and four wheels on struts."""
    wide, long = 0.92 * sides[0], 0.92 * sides[2]
    shell, dark = palette.any_surface(0.6), palette.metal()
    wheel = min(0.13, floor / 4)
    deep = 0.1
    pieces = [
        Part("box", (0.0, 0.03 + deep, 0.0), (wide, deep, long), shell),
        Part("box", (0.0, 0.0, -0.65 * long), (0.5 * wide, 0.05, 0.25 * long), dark),
    ]
    strut = (floor - wheel - 0.05 - 2 * deep) / 2
    for x in (-1.0, 1.0):
        for z in (-0.6, 0.6):
            corner = (x * 0.9 * wide, z * long)
            if strut > 0:
                height = 0.03 + 2 * deep + strut
                pieces.append(Part("cylinder", (corner[0], height, corner[1]), (0.02, strut, 0.02), dark))
            hub = (x * (0.9 * wide + 0.05), floor - wheel - 0.002, corner[1])
            pieces.append(Part("cylinder", hub, (wheel, 0.04, wheel), dark, rotation=ABOUT_X))
    return pieces
