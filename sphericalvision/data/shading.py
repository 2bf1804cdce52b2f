# SPDX-License-Identifier: Apache-2.0
"""Light that bundles of rays bring back: textures, lamps with their shadows, ambient light, and one reflection."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sphericalvision.data.bundles import RAYS, Bundles, bundled
from sphericalvision.data.raycast import blocked, first_hits
from sphericalvision.data.scene import Scene
from sphericalvision.data.surfaces import describe
from sphericalvision.data.textures import TextureBank, texture_bank

__all__ = ["Looks", "radiance"]

#: Shadow rays end this far before the surface that they test, and reflections start so far from it (metres).
SHADOW_GAP = 2e-3
#: Rays in a bundle of points that are sorted by primitive; divides RAYS.
SORTED = 64


@dataclass(frozen=True)
class Looks:
    """What the surfaces of a scene look like, by primitive, so that a ray looks up one table only.

    Attributes:
        numbers: ``(8, P)``: the map from surface coordinates to the texture's (2 x 2, by rows), its offset
            across and down, texture sides per metre, and light given off.
        dark: ``(3, P)`` reflectance where the texture is black.
        range: ``(3, P)`` what is added to it where the texture is white.
        texture: ``(P,)`` numbers of textures, int32.
        mirror: ``(P,)`` shares of light that are reflected as by a mirror.
        bank: the textures.
    """

    numbers: Tensor
    dark: Tensor
    range: Tensor
    texture: Tensor
    mirror: Tensor
    bank: TextureBank

    @classmethod
    def of(cls, scene: Scene) -> Looks:
        """The table of a scene."""
        table, material = scene.materials, scene.primitives.material
        turn = table.texture_from_surface[material]  # (P, 2, 2)
        offset = (turn @ scene.primitives.uv_origin[:, :, None])[:, :, 0] + table.offset[material]
        density = turn.norm(dim=-1).amax(-1)
        columns = [turn.flatten(1), offset, density[:, None], table.emission[material][:, None]]
        dark = table.dark[material].T.contiguous()
        return cls(
            numbers=torch.cat(columns, 1).T.contiguous(),
            dark=dark,
            range=table.bright[material].T - dark,
            texture=table.texture[material].int(),
            mirror=table.mirror[material],
            bank=texture_bank(str(scene.device)),
        )


def radiance(scene: Scene, looks: Looks, rays: Bundles, spread: Tensor, bounces: int = 1) -> Tensor:
    """Linear light ``(3, b, RAYS)``, not yet exposed.

    Args:
        scene: the scene.
        looks: its `Looks`.
        rays: bundles of unit directions.
        spread: ``(b, RAYS)`` angles between neighbouring rays.
        bounces: how often reflections are followed.
    """
    distance, row = first_hits(scene.primitives, rays)
    met = row >= 0
    all_met = bool(met.all())
    if not all_met:
        distance, row = distance.masked_fill(~met, 1.0), row.clamp(min=0)
    position = torch.addcmul(rays.origin, rays.direction, distance)
    direction, places, rows = rays.direction.flatten(1), position.flatten(1), row.flatten()
    normal, uv = describe(scene.primitives, places, direction, rows)
    light, glow = _albedo(looks, uv, normal, direction, rows, (distance * spread).flatten())
    lit = _irradiance(scene, position, normal.view_as(position), row)
    light *= torch.where(glow > 0, glow, lit.flatten(1))
    if bounces and bool((looks.mirror > 0).any()):
        glossy = (looks.mirror > 0).index_select(0, rows).logical_and_(met.flatten()).nonzero()[:, 0]
        if len(glossy):
            light[:, glossy] = _reflected(
                scene, looks, places, normal, direction, spread.flatten(), rows, light, glossy, bounces
            )
    light = light.view_as(position)
    if all_met:
        return light
    up = (0.5 - 2 * rays.direction[1]).clamp(0, 1)
    above, below = scene.background[:, :, None, None]
    return torch.where(met, light, torch.lerp(below, above, up))


def _reflected(
    scene: Scene,
    looks: Looks,
    position: Tensor,
    normal: Tensor,
    direction: Tensor,
    spread: Tensor,
    row: Tensor,
    light: Tensor,
    glossy: Tensor,
    bounces: int,
) -> Tensor:
    """The light ``(3, k)`` of the ``k`` rays numbered ``glossy``, mixed with what their mirrors show."""
    ray, normal, position, light = (x.index_select(1, glossy) for x in (direction, normal, position, light))
    away = torch.add(position, normal, alpha=SHADOW_GAP)
    mirrored = torch.addcmul(ray, normal, (ray * normal).sum(0), value=-2)
    rays = Bundles(bundled(away), bundled(mirrored))
    seen = radiance(scene, looks, rays, bundled(spread.index_select(0, glossy) * 2), bounces - 1)
    share = looks.mirror.index_select(0, row.index_select(0, glossy))
    return torch.lerp(light, seen.flatten(1)[:, : len(glossy)], share)


def _albedo(
    looks: Looks, uv: Tensor, normal: Tensor, direction: Tensor, row: Tensor, width: Tensor
) -> tuple[Tensor, Tensor]:
    """Reflectance ``(3, n)``, filtered over rays that are ``width`` metres wide when they arrive, and emission."""
    a, b, c, d, across, down, density, glow = looks.numbers.index_select(1, row)
    across.addcmul_(a, uv[0]).addcmul_(b, uv[1])
    down.addcmul_(c, uv[0]).addcmul_(d, uv[1])
    slant = (direction * normal).sum(0).abs_().clamp_(min=0.02)
    # A slanted surface is crossed by an ellipse 1 / slant long; its mean width balances blur and aliasing.
    # The box filters of a mip pyramid let some aliasing through: a little wider looks better.
    footprint = slant.rsqrt_().mul_(width).mul_(density).mul_(1.25)
    value = looks.bank.columns(looks.texture.index_select(0, row), across, down, footprint)
    return torch.addcmul(looks.dark.index_select(1, row), looks.range.index_select(1, row), value), glow


def _irradiance(scene: Scene, position: Tensor, normal: Tensor, row: Tensor) -> Tensor:
    """Light that arrives at surfaces ``(3, b, RAYS)``: ambient, more from above, and all lamps in sight.

    Bundles that see one primitive stay as they are. Points of the others are sorted by primitive and go in smaller
    bundles: as the lamps see them, neighbours on different primitives may be far apart.
    """
    alone = (row == row[:, :1]).all(1)
    mixed = (~alone).nonzero()[:, 0]
    if not len(mixed):
        return _lit(scene, position, normal, row)
    light = torch.empty_like(position)
    whole = alone.nonzero()[:, 0]
    if len(whole):
        lit = _lit(scene, *(x.index_select(1, whole) for x in (position, normal)), row.index_select(0, whole))
        light.index_copy_(1, whole, lit)
    rows = row.index_select(0, mixed)
    order = rows.flatten().argsort(stable=True)
    numbers = (mixed[:, None] * RAYS + torch.arange(RAYS, device=row.device)).flatten()[order].view(-1, SORTED)
    lit = _lit(
        scene,
        *(x.flatten(1).index_select(1, numbers.flatten()).view(3, *numbers.shape) for x in (position, normal)),
        rows.flatten()[order].view(numbers.shape),
    )
    light.flatten(1).index_copy_(1, numbers.flatten(), lit.flatten(1))
    return light


def _lit(scene: Scene, position: Tensor, normal: Tensor, row: Tensor) -> Tensor:
    """`_irradiance` of bundles ``(3, b, r)``."""
    light = scene.ambient[:, None, None] * (1 - 0.25 * normal[1])
    casters = scene.primitives.shadow_casters
    # A convex primitive throws no shadow on its own lit side.
    own = torch.where((row == row[:, :1]).all(1), scene.primitives.caster_row[row[:, 0]], -1)
    for lamp, color, reach in zip(
        scene.lamps.position[:, :, None, None], scene.lamps.color, scene.lamps.reach, strict=True
    ):
        ray = position - lamp
        squared = ray.square().sum(0)
        slant = (normal * ray).sum(0).neg_().clamp_(min=0)
        lit = slant.amax(1).nonzero()[:, 0]
        if not len(lit):
            continue
        distance = squared.sqrt()
        limit = 1 - SHADOW_GAP / distance
        strength = slant.div_(distance).div_(squared.add_(reach**2))
        if len(lit) < len(slant):
            ray, limit, own_lit = ray.index_select(1, lit), limit.index_select(0, lit), own.index_select(0, lit)
        else:
            own_lit = own
        hidden = blocked(casters, Bundles(lamp, ray), limit, own_lit)
        strength.index_put_((lit,), strength.index_select(0, lit).masked_fill_(hidden, 0))
        light.addcmul_(strength, color[:, None, None])
    return light
