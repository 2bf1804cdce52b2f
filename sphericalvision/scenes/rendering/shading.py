# SPDX-License-Identifier: Apache-2.0
"""Shading of what rays hit: normals, textures, lamps with their shadows, ambient light, and one reflection."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from sphericalvision.scenes.rendering.primitives import SHAPES, Primitives
from sphericalvision.scenes.rendering.ray_packets import RAYS, RayPackets, packed
from sphericalvision.scenes.rendering.raycast import blocked, first_hits, picked
from sphericalvision.scenes.rendering.scene import Scene, sky_light
from sphericalvision.scenes.rendering.textures import TextureBank, texture_bank

#: Shadow rays end this far before the surface that they test, and reflections start so far from it (metres).
SHADOW_GAP = 2e-3
#: Rays in a packet of points that are sorted by primitive; divides RAYS.
SORTED = 64


@dataclass(frozen=True)
class SurfaceTable:
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
    def of(cls, scene: Scene) -> SurfaceTable:
        """The table of a scene."""
        table, material = scene.materials, scene.primitives.material
        rotation = table.texture_from_surface[material]  # (P, 2, 2)
        offset = (rotation @ scene.primitives.uv_origin[:, :, None])[:, :, 0] + table.offset[material]
        density = rotation.norm(dim=-1).amax(-1)
        columns = [rotation.flatten(1), offset, density[:, None], table.emission[material][:, None]]
        dark = table.dark[material].T.contiguous()
        return cls(
            numbers=torch.cat(columns, 1).T.contiguous(),
            dark=dark,
            range=table.bright[material].T - dark,
            texture=table.texture[material].int(),
            mirror=table.mirror[material],
            bank=texture_bank(str(scene.device)),
        )


class SurfaceSamples(NamedTuple):
    """Points on surfaces, in packets.

    Attributes:
        position: ``(3, b, r)`` metres.
        normal: ``(3, b, r)``.
        side: ``(b, r)`` the primitive that each lies on; the inner side of primitive p is -1 - p.
    """

    position: Tensor
    normal: Tensor
    side: Tensor

    def alone(self) -> Tensor:
        """Which packets lie on one side of one primitive ``(b,)``."""
        return (self.side == self.side[:, :1]).all(1)


def radiance(scene: Scene, table: SurfaceTable, rays: RayPackets, spread: Tensor, bounces: int = 1) -> Tensor:
    """Linear light ``(3, b, RAYS)``, not yet exposed.

    Args:
        scene: the scene.
        table: its `SurfaceTable`.
        rays: packets of unit directions.
        spread: ``(b, RAYS)`` angles between neighbouring rays.
        bounces: how often reflections are followed.
    """
    distance, hit = first_hits(scene.primitives, rays)
    met = hit >= 0
    if bool(met.all()):
        return _surfaces(scene, table, rays, spread, distance, hit, bounces)
    # Packets at the horizon are in both lists: sky first, and surfaces replace it ray by ray.
    sky, ground = (~met).any(1).nonzero()[:, 0], met.any(1).nonzero()[:, 0]
    light = torch.empty_like(rays.direction)
    above = rays.direction.index_select(1, sky)
    light.index_copy_(1, sky, sky_light(scene.background, scene.clouds, above))
    if len(ground):
        origin, direction, behind = (picked(each, ground) for each in (*rays, light))
        spread, distance, hit = (each.index_select(0, ground) for each in (spread, distance, hit))
        seen = _surfaces(scene, table, RayPackets(origin, direction), spread, distance, hit, bounces)
        light.index_copy_(1, ground, torch.where(hit >= 0, seen, behind))
    return light


def _surfaces(
    scene: Scene,
    table: SurfaceTable,
    rays: RayPackets,
    spread: Tensor,
    distance: Tensor,
    hit: Tensor,
    bounces: int,
) -> Tensor:
    """`radiance` of what rays hit, from `first_hits`; anything where they hit nothing.

    By ray, with reflectance ρ, mirrored fraction m and fog density f, this is

        light = ρ · (glow if glow > 0 else irradiance(position))
        light = (1 - m) · light + m · radiance(reflected ray)
        light = haze + (light - haze) · exp(-f · distance)

    All steps but the last change ``light`` in place: it is the largest array of a picture.
    """
    # Rays without a hit are computed along with the others, as if 1 m away on primitive 0, so that packets stay whole.
    met = hit >= 0
    distance, row = distance.masked_fill_(~met, 1), hit.clamp(min=0)
    position = torch.addcmul(rays.origin, rays.direction, distance)
    direction, rows = rays.direction.flatten(1), row.flatten()
    normal, uv, inner = normals_and_uv(scene.primitives, position.flatten(1), direction, rows)
    light, glow = _albedo(table, uv, normal, direction, rows, (distance * spread).flatten())
    # -1 - row on the inner side: x ^ -1 is the complement, x ^ 0 is x
    side = row ^ -inner.view_as(row).long()
    arriving = irradiance(scene, SurfaceSamples(position, normal.view_as(position), side))
    # A weight of 0 or 1 makes `lerp` a choice, which on a CPU is faster than `where`.
    light.mul_(torch.lerp(arriving.flatten(1), glow.expand_as(light), (glow > 0).to(glow)))
    if bounces and bool((table.mirror > 0).any()):
        glossy = (table.mirror > 0).index_select(0, rows).logical_and_(met.flatten()).nonzero()[:, 0]
        if len(glossy):
            spot, ray, outward = (x.index_select(1, glossy) for x in (position.flatten(1), direction, normal))
            # Twice the angle: they have spread on the way to the mirror already.
            wider = packed(2 * spread.flatten()[glossy])
            seen = radiance(scene, table, _reflected(spot, ray, outward), wider, bounces - 1)
            reflectance = table.mirror.index_select(0, rows[glossy])
            mixed = torch.lerp(light.index_select(1, glossy), seen.flatten(1)[:, : len(glossy)], reflectance)
            _write(light, glossy, mixed)
    light = light.view_as(position)
    if scene.fog:
        haze = sky_light(scene.background, scene.clouds[:0], rays.direction)  # of the sky without clouds
        light = torch.lerp(haze, light, distance.mul(-scene.fog).exp_())
    return light


def _write(columns: Tensor, places: Tensor, values: Tensor) -> None:
    """Write values ``(c, m)`` at places ``(m,)`` of ``(c, n)``; on a CPU in a third of index_copy_'s time."""
    columns.scatter_(1, places.expand_as(values), values)


def _reflected(position: Tensor, ray: Tensor, normal: Tensor) -> RayPackets:
    """Mirrored rays of ``(3, n)`` points."""
    start = torch.add(position, normal, alpha=SHADOW_GAP)
    mirrored = torch.addcmul(ray, normal, (ray * normal).sum(0), value=-2)
    return RayPackets(packed(start), packed(mirrored))


def _albedo(
    table: SurfaceTable, uv: Tensor, normal: Tensor, direction: Tensor, row: Tensor, width: Tensor
) -> tuple[Tensor, Tensor]:
    """Reflectance ``(3, n)``, filtered over rays that are ``width`` metres wide when they arrive, and emission."""
    a, b, c, d, across, down, density, glow = table.numbers.index_select(1, row)
    across.addcmul_(a, uv[0]).addcmul_(b, uv[1])
    down.addcmul_(c, uv[0]).addcmul_(d, uv[1])
    slant = (direction * normal).sum(0).abs_().clamp_(min=0.02)
    # A slanted surface is crossed by an ellipse 1 / slant long; its mean width balances blur and aliasing.
    # The box filters of a mip pyramid let some aliasing through: a little wider looks better.
    footprint = slant.rsqrt_().mul_(width).mul_(density).mul_(1.25)
    value = table.bank.columns(table.texture.index_select(0, row), across, down, footprint)
    return torch.addcmul(table.dark.index_select(1, row), table.range.index_select(1, row), value), glow


def irradiance(scene: Scene, points: SurfaceSamples) -> Tensor:
    """Light that arrives at points ``(3, b, RAYS)``: ambient, more from above, and all lamps in sight.

    Packets of points on one primitive stay as they are. The points of the others are sorted by primitive and go in
    smaller packets: neighbours on different primitives may be far apart as the lamps see them.
    """
    alone = points.alone()
    mixed = (~alone).nonzero()[:, 0]
    light = torch.empty_like(points.position)
    whole = alone.nonzero()[:, 0]
    if len(whole):
        light.index_copy_(1, whole, _lit(scene, SurfaceSamples(*(x.index_select(-2, whole) for x in points))))
    if len(mixed):
        order = points.side.index_select(0, mixed).flatten().argsort(stable=True)
        number = mixed[:, None] * RAYS + torch.arange(RAYS, device=mixed.device)
        number = number.flatten().index_select(0, order)
        sorted_points = (
            x.flatten(-2).index_select(-1, number).view(*x.shape[:-2], -1, SORTED) for x in points
        )
        _write(light.flatten(1), number, _lit(scene, SurfaceSamples(*sorted_points)).flatten(1))
    return light


def _lit(scene: Scene, points: SurfaceSamples) -> Tensor:
    """`irradiance` of packets of any number of points."""
    position, normal, side = points
    light = scene.ambient[:, None, None] * (1 - 0.25 * normal[1])
    # A convex primitive throws no shadow on its own outer side, where that faces the lamp.
    own = scene.primitives.caster_row.index_select(0, side[:, 0].clamp(min=0))
    own = torch.where(points.alone() & (side[:, 0] >= 0), own, -1)
    lamps = zip(scene.lamps.position[:, :, None, None], scene.lamps.color, scene.lamps.reach, strict=True)
    for lamp, color, reach in lamps:
        ray = position - lamp
        slant = (normal * ray).sum(0).neg_().clamp_(min=0)
        lit = slant.amax(1).nonzero()[:, 0]
        if not len(lit):
            continue
        squared = ray.square().sum(0)
        distance = squared.sqrt()
        strength = slant.div_(distance).div_(squared.add_(reach**2))
        limit = 1 - SHADOW_GAP / distance.index_select(0, lit)
        rays = RayPackets(lamp, ray.index_select(1, lit))
        hidden = blocked(scene.primitives.shadow_casters, rays, limit, own.index_select(0, lit))
        strength.index_copy_(0, lit, strength.index_select(0, lit).masked_fill_(hidden, 0))
        light.addcmul_(strength, color[:, None, None])
    return light


def normals_and_uv(
    primitives: Primitives, position: Tensor, direction: Tensor, row: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Unit normals on the rays' side, surface coordinates without their origin, and whether that side is the inner.

    A rectangle has no inner side.

    Args:
        primitives: the table.
        position: ``(3, n)`` points, metres.
        direction: ``(3, n)`` of the rays that met them.
        row: ``(n,)`` the primitives that they lie on.

    Returns:
        ``(3, n)``, ``(2, n)`` in metres, and bool ``(n,)``.
    """
    axes = primitives.rotation.permute(2, 1, 0).contiguous()  # (world, local, P)
    offset = position - primitives.center.T.index_select(1, row)
    metres = axes[0].index_select(1, row).mul_(offset[0])
    metres.addcmul_(axes[1].index_select(1, row), offset[1])
    metres.addcmul_(axes[2].index_select(1, row), offset[2])
    # Boxes and rectangles first, for all points: the face is where the coordinate is largest.
    flat = primitives.shape == SHAPES.index("rectangle")
    size = primitives.half.T.reciprocal()
    size[:2, flat] = 0
    x, y, z = metres.abs().mul_(size.index_select(1, row))
    on_x = x > torch.maximum(y, z)
    on_y = (y > z).logical_and_(~on_x)
    uv = torch.stack([torch.where(on_x, metres[2], metres[0]), torch.where(on_y, metres[2], metres[1])])
    face = (row * 3 + 2).sub_(on_y.long()).sub_(on_x.long(), alpha=2)
    normal = primitives.rotation.flatten(0, 1).T.contiguous().index_select(1, face)
    for name, shape in _ROUND.items():
        rows = primitives.shape == SHAPES.index(name)
        on = rows.index_select(0, row).nonzero()[:, 0] if bool(rows.any()) else row[:0]
        if len(on):
            which = row.index_select(0, on)
            half = primitives.half.T.index_select(1, which)
            local = metres.index_select(1, on)
            outward, along = shape(local / half, local, half)
            outward /= half
            x, y, z = ((axes[k].index_select(1, which) * outward).sum(0) for k in (0, 1, 2))
            length = (x * x).addcmul_(y, y).addcmul_(z, z).rsqrt_()
            _write(normal, on, torch.stack([x, y, z]).mul_(length))
            _write(uv, on, along)
    faces_away = (normal * direction).sum(0) > 0
    normal.mul_(1 - 2 * faces_away.to(normal.dtype))
    return normal, uv, faces_away.logical_and_(~flat.index_select(0, row))


def _ellipsoid(unit: Tensor, metres: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    longitude = torch.atan2(unit[0], unit[2])
    latitude = torch.atan2(unit[1], _across(unit))
    return unit.clone(), torch.stack([longitude * half[0], latitude * half[1]])


def _across(unit: Tensor) -> Tensor:
    """Distance from the local y axis, for coordinates of the order of 1."""
    return (unit[0] * unit[0]).addcmul_(unit[2], unit[2]).sqrt_()


def _cylinder(unit: Tensor, metres: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    on_cap = unit[1].abs() > _across(unit)
    side = torch.stack([unit[0], torch.zeros_like(unit[1]), unit[2]])
    cap = torch.zeros_like(unit)
    cap[1] = unit[1].sign()
    around = torch.stack([torch.atan2(unit[0], unit[2]) * half[0], metres[1]])
    return torch.where(on_cap, cap, side), torch.where(on_cap, metres[::2], around)


#: Unit shapes' normals (of any length) and surface coordinates in metres.
_ROUND: dict[str, Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]] = {
    "ellipsoid": _ellipsoid,
    "cylinder": _cylinder,
}
