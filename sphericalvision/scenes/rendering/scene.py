# SPDX-License-Identifier: Apache-2.0
"""A scene: primitives, their materials, the lamps that light them, and the sky."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.scenes.rendering.primitives import Primitives, map_columns

Color = tuple[float, float, float]


class Material(NamedTuple):
    """How a surface looks, in plain numbers.

    A texture value x in [0, 1] (per channel) becomes the reflectance ``dark + (bright - dark) * x``.

    Attributes:
        texture: number in the texture bank.
        dark: linear RGB reflectance where the texture is black.
        bright: and where it is white.
        tile: metres of surface that one texture side covers (across, down).
        turn: texture rotation on the surface, radians.
        offset: texture coordinates at the surface's origin.
        emission: light given off, as a multiple of the reflectance (lamps, screens, a sky).
        mirror: share of light that is reflected as by a mirror.
    """

    texture: int
    dark: Color = (0.0, 0.0, 0.0)
    bright: Color = (1.0, 1.0, 1.0)
    tile: tuple[float, float] = (1.0, 1.0)
    turn: float = 0.0
    offset: tuple[float, float] = (0.5, 0.5)
    emission: float = 0.0
    mirror: float = 0.0


class Lamp(NamedTuple):
    """A point lamp: intensity ``color / (reach² + distance²)``; ``reach`` (metres) bounds it nearby."""

    position: tuple[float, float, float]
    color: Color
    reach: float = 0.5


@dataclass(frozen=True)
class Materials:
    """Materials as a table of M rows."""

    texture: Tensor  # (M,)
    dark: Tensor  # (M, 3)
    bright: Tensor  # (M, 3)
    texture_from_surface: Tensor  # (M, 2, 2), texture sides per metre
    offset: Tensor  # (M, 2)
    emission: Tensor  # (M,)
    mirror: Tensor  # (M,)


@dataclass(frozen=True)
class Lamps:
    """Lamps as a table of L rows."""

    position: Tensor  # (L, 3) metres
    color: Tensor  # (L, 3)
    reach: Tensor  # (L,) metres


@dataclass(frozen=True)
class Scene:
    """Everything that rendering needs, in one frame and on one device.

    Attributes:
        primitives: what rays hit.
        materials: what ``primitives.material`` counts.
        lamps: point lamps with shadows.
        ambient: ``(3,)`` light from everywhere.
        background: ``(2, 3)`` colours above and below the horizon where rays hit nothing.
        exposure: scalar that multiplies all light before it becomes a picture.
        clouds: ``(K, 5)`` waves of clouds before the background (see ``sky_light``); none by default.
        fog: share of light that a metre of air swaps for the background's, per metre; none by default.

    Examples:
        >>> from sphericalvision.scenes import make_scene
        >>> scene = make_scene("room", seed=1)
        >>> scene.lamps.position.shape[-1], scene.background.shape
        (3, torch.Size([2, 3]))
    """

    primitives: Primitives
    materials: Materials
    lamps: Lamps
    ambient: Tensor
    background: Tensor
    exposure: Tensor
    clouds: Tensor = field(default_factory=lambda: torch.zeros(0, 5))
    fog: float = 0.0

    @property
    def device(self) -> torch.device:
        return self.ambient.device

    def to(self, device: torch.device | str) -> Scene:
        """The scene on another device."""

        def move(value: Any) -> Any:
            if isinstance(value, Tensor):
                return value.to(device)
            return map_columns(move, value) if is_dataclass(value) else value

        return map_columns(move, self)

    def transformed(
        self, rotation: Float[Tensor, "3 3"] | None = None, translation: Float[Tensor, " 3"] | None = None
    ) -> Scene:
        """The scene turned by ``rotation`` ``(3, 3)`` then moved by ``translation`` (metres)."""
        position = self.lamps.position
        if rotation is not None:
            position = position @ rotation.T
        if translation is not None:
            position = position + translation
        primitives = self.primitives.transformed(rotation, translation)
        return replace(self, primitives=primitives, lamps=replace(self.lamps, position=position))

    def scaled(self, factor: float) -> Scene:
        """The scene with every length multiplied by ``factor``; it looks the same to a rig scaled alike."""
        materials = replace(self.materials, texture_from_surface=self.materials.texture_from_surface / factor)
        lamps = Lamps(self.lamps.position * factor, self.lamps.color * factor**2, self.lamps.reach * factor)
        table = self.primitives.scaled(factor)
        return replace(self, primitives=table, materials=materials, lamps=lamps, fog=self.fog / factor)

    def joined(self, more: Primitives, materials: Materials) -> Scene:
        """The scene with more in it, whose materials are those given; its light and exposure stay."""

        def both(*columns: Tensor) -> Tensor:
            return torch.cat(columns)

        placed = replace(more, material=more.material + len(self.materials.texture))
        return replace(
            self,
            primitives=map_columns(both, self.primitives, placed),
            materials=map_columns(both, self.materials, materials),
        )


def pack_materials(materials: Sequence[Material]) -> Materials:
    """Make the table of a list of materials (float32, CPU)."""

    def column(values: list) -> Tensor:
        return torch.tensor(values, dtype=torch.float32)

    angle = column([m.turn for m in materials])
    rotation = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], -1).reshape(-1, 2, 2)
    return Materials(
        texture=torch.tensor([m.texture for m in materials]),
        dark=column([m.dark for m in materials]),
        bright=column([m.bright for m in materials]),
        texture_from_surface=rotation / column([m.tile for m in materials])[:, :, None],
        offset=column([m.offset for m in materials]),
        emission=column([m.emission for m in materials]),
        mirror=column([m.mirror for m in materials]),
    )


def pack_lamps(lamps: Sequence[Lamp]) -> Lamps:
    """Make the table of a list of lamps (float32, CPU)."""
    return Lamps(
        position=torch.tensor([lamp.position for lamp in lamps], dtype=torch.float32).reshape(-1, 3),
        color=torch.tensor([lamp.color for lamp in lamps], dtype=torch.float32).reshape(-1, 3),
        reach=torch.tensor([lamp.reach for lamp in lamps], dtype=torch.float32),
    )


def sky_light(
    background: Float[Tensor, "2 3"], clouds: Float[Tensor, "K 5"], direction: Float[Tensor, "3 ..."]
) -> Float[Tensor, "3 ..."]:
    """Return the linear colours ``(3, ...)`` of the sky in directions ``(3, ...)``.

    Args:
        background: ``(2, 3)`` colours above and below the horizon.
        clouds: ``(K, 5)`` waves over the unit sphere: wave vector, phase and amplitude. Their sum, as a logit, is the
            share of the sky's brightest value in place of its colour. None where K is 0.
        direction: unit vectors, y down.

    Examples:
        >>> blue_over_grey = torch.tensor([[0.2, 0.4, 0.9], [0.5, 0.5, 0.5]])
        >>> sky_light(blue_over_grey, torch.zeros(0, 5), torch.tensor([0.0, -1.0, 0.0]))
        tensor([0.2000, 0.4000, 0.9000])
        >>> overcast = torch.tensor([[0.0, 0.0, 0.0, 1.5708, 9.0]])
        >>> sky_light(blue_over_grey, overcast, torch.tensor([0.0, -1.0, 0.0]))
        tensor([0.8999, 0.8999, 0.9000])
    """
    up = (0.5 - 2 * direction[1]).clamp(0, 1)
    above, below = background.view(2, 3, *[1] * up.ndim)
    color = torch.lerp(below, above, up)
    if len(clouds):
        cover = torch.zeros_like(up)
        for *wave, phase, amplitude in clouds.tolist():
            angle = wave[0] * direction[0] + wave[1] * direction[1] + (wave[2] * direction[2] + phase)
            cover.add_(angle.sin_(), alpha=amplitude)
        color = torch.lerp(color, background.amax().expand_as(color), cover.sigmoid_())
    return color
