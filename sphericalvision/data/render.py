# SPDX-License-Identifier: Apache-2.0
"""Pictures and exact depth of a scene, through any camera.

Light is Lambert shading by point lamps that cast shadows, plus ambient light; mirrors show one reflection.
Colours are computed in linear light and become a picture by the scene's exposure and a display curve (power 1
/ 2.2).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from sphericalvision.core import ArgumentError, check_last_dim
from sphericalvision.data.raycast import Hit, Surface, occluded, surface, trace
from sphericalvision.data.scene import Scene
from sphericalvision.data.textures import texture_bank

if TYPE_CHECKING:
    from sphericalvision.cameras import Camera, CameraRig

__all__ = ["ray_depth", "render_camera", "render_directions", "render_rig"]

#: Rays shaded at once on the CPU, so that results stay in the cache; other devices take many more.
CHUNK = 16384
#: Side of the squares of pixels that are rendered one after the other: a chunk is one, so its rays are neighbours.
TILE = 128
#: Shadow rays end this far before the surface that they test (metres).
SHADOW_GAP = 2e-3


def ray_depth(scene: Scene, origin: Tensor, directions: Tensor) -> Tensor:
    """Exact distances from a point along rays.

    Args:
        scene: the scene.
        origin: ``(3,)`` metres, for example ``rig.center``.
        directions: ``(*, 3)`` unit directions of any grid, for example ``Icosphere(5).vertices``.

    Returns:
        Metres along each ray ``(*)``; inf where the ray leaves the scene.

    Examples:
        >>> from sphericalvision.data.scenes import make_scene
        >>> depth = ray_depth(make_scene("room", seed=0), torch.zeros(3), torch.tensor([[0.0, 1.0, 0.0]]))
        >>> bool(depth > 0.5)
        True
    """
    directions = directions.to(scene.device, torch.float32)
    return trace(scene.primitives, origin.to(directions), directions).distance


def render_directions(
    scene: Scene, origin: Tensor, directions: Tensor, spread: float | Tensor | None = None
) -> Tensor:
    """Colours seen from a point along rays.

    Args:
        scene: the scene.
        origin: ``(3,)`` metres.
        directions: ``(*, 3)`` unit directions.
        spread: angle in radians between neighbouring rays, a number or ``(*)``: textures are averaged over
            it.
            None: as if the rays covered the sphere evenly.

    Returns:
        ``(3, *)`` in [0, 1].
    """
    check_last_dim("directions", directions, 3)
    directions = directions.to(scene.device, torch.float32)
    if spread is None:
        spread = (4 * torch.pi / max(1, directions.numel() // 3)) ** 0.5
    light = _radiance(scene, origin.to(directions), directions, torch.as_tensor(spread).to(directions))
    return _develop(scene, light)


def render_camera(
    scene: Scene, camera: Camera, world_from_camera: Tensor, samples_per_pixel: int = 1
) -> Tensor:
    """The picture that one camera takes.

    Args:
        scene: the scene.
        camera: any camera (not batched).
        world_from_camera: its pose ``(4, 4)``.
        samples_per_pixel: stratified rays through each pixel; a pixel is the mean over those that the camera
            sees.

    Returns:
        ``(3, h, w)`` in [0, 1]; 0 where the camera sees nothing.

    Raises:
        ArgumentError: ``samples_per_pixel`` below 1.
    """
    if samples_per_pixel < 1:
        raise ArgumentError(f"samples_per_pixel: expected at least 1, got {samples_per_pixel}")
    pose = world_from_camera.to(scene.device, torch.float32)
    height, width = camera.image_size
    down, across = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    centers = torch.stack([across, down], -1).float()
    tiles = (down // TILE * width + across // TILE).flatten().argsort(stable=True).to(scene.device)
    total = torch.zeros(3, height * width, device=scene.device)
    count = torch.zeros(height * width, device=scene.device)
    for offset in _stratified(samples_per_pixel):
        seen = camera.unproject(centers + offset)
        pixels = tiles[seen.valid.flatten().to(scene.device)[tiles]]
        local = seen.directions.to(scene.device, torch.float32)
        directions = local.reshape(-1, 3)[pixels] @ pose[:3, :3].T
        spread = _spread(local).flatten()[pixels] / samples_per_pixel**0.5
        light = _radiance(scene, pose[:3, 3], directions, spread).clamp(max=4)
        total.index_add_(1, pixels, light)
        count[pixels] += 1
    picture = _develop(scene, total / count.clamp(min=1))
    return picture.view(3, height, width)


def render_rig(scene: Scene, rig: CameraRig, samples_per_pixel: int = 1) -> dict[str, Tensor]:
    """The pictures that all cameras of a rig take: name -> ``(3, h, w)`` in [0, 1]; see `render_camera`."""
    poses = zip(rig.cameras.items(), rig.world_from_camera, strict=True)
    return {name: render_camera(scene, camera, pose, samples_per_pixel) for (name, camera), pose in poses}


def _develop(scene: Scene, light: Tensor) -> Tensor:
    return light.clamp(0, 1) ** (1 / 2.2)


def _stratified(count: int) -> Tensor:
    """Offsets ``(count, 2)`` in (-0.5, 0.5) pixels, one in each of ``count`` rows and columns; mean 0."""
    order = sorted(range(count), key=lambda k: f"{k:032b}"[::-1])
    ranks = torch.tensor([list(range(count)), order], dtype=torch.float32)
    return ((ranks + 0.5) / count - 0.5).T


def _spread(directions: Tensor) -> Tensor:
    """Angle between neighbouring pixels' rays ``(h, w)``, at most twice the smaller of down and across."""
    steps = []
    for axis in (0, 1):
        step = (directions.diff(dim=axis)).norm(dim=-1)
        last = step.narrow(axis, step.shape[axis] - 1, 1)
        steps.append(torch.cat([step, last], axis))
    return torch.minimum(torch.maximum(*steps), 2 * torch.minimum(*steps))


def _radiance(scene: Scene, origin: Tensor, directions: Tensor, spread: Tensor) -> Tensor:
    """Exposed linear light ``(3, *)`` along rays from one point."""
    shape = directions.shape[:-1]
    rays, spread = directions.reshape(-1, 3), spread.expand(shape).reshape(-1)
    size = CHUNK if rays.device.type == "cpu" else 64 * CHUNK
    parts = [
        _shade(scene, origin, d, s, bounces=1)
        for d, s in zip(rays.split(size), spread.split(size), strict=True)
    ]
    return (torch.cat(parts) * scene.exposure).T.reshape(3, *shape)


def _shade(scene: Scene, origins: Tensor, directions: Tensor, spread: Tensor, bounces: int) -> Tensor:
    """Linear light ``(n, 3)``; reflections are followed ``bounces`` times."""
    hit = trace(scene.primitives, origins, directions)
    up = (0.5 - 2 * directions[:, 1:2]).clamp(0, 1)
    light = torch.lerp(scene.background[1], scene.background[0], up)
    met = (hit.primitive >= 0).nonzero()[:, 0]
    if not len(met):
        return light
    origins = origins if origins.ndim == 1 else origins[met]
    rays, hit, spread = directions[met], Hit(hit.distance[met], hit.primitive[met]), spread[met]
    spot = surface(scene.primitives, origins, rays, hit)
    material = scene.primitives.material[hit.primitive]
    albedo = _albedo(scene, spot, material, rays, hit.distance * spread)
    glow = scene.materials.emission[material][:, None]
    answer = albedo * torch.where(glow > 0, glow, _irradiance(scene, spot))
    mirror = scene.materials.mirror[material]
    glossy = (mirror > 0).nonzero()[:, 0] if bounces else mirror.new_zeros(0, dtype=torch.long)
    if len(glossy):
        ray, normal = rays[glossy], spot.normal[glossy]
        reflected = ray - 2 * (ray * normal).sum(-1, keepdim=True) * normal
        away = spot.position[glossy] + SHADOW_GAP * normal
        seen = _shade(scene, away, reflected, spread[glossy] * 2, bounces - 1)
        answer[glossy] = torch.lerp(answer[glossy], seen, mirror[glossy][:, None])
    light[met] = answer
    return light


def _albedo(scene: Scene, spot: Surface, material: Tensor, rays: Tensor, width: Tensor) -> Tensor:
    """Reflectance ``(n, 3)``, filtered over rays that are ``width`` metres wide when they arrive."""
    table = scene.materials
    turn = table.texture_from_surface[material]
    uv = (turn * spot.uv[:, None, :]).sum(-1) + table.offset[material]
    slant = (rays * spot.normal).sum(-1).abs().clamp(min=0.02)
    density = table.texture_from_surface.norm(dim=-1).amax(-1)[material]
    # A slanted surface is crossed by an ellipse 1 / slant long; its mean width balances blur and aliasing.
    # The box filters of a mip pyramid let some aliasing through: a little wider looks better.
    value = texture_bank(str(scene.device)).sample(
        table.texture[material], uv, 1.25 * width * slant.rsqrt() * density
    )
    return torch.lerp(table.dark[material], table.bright[material], value)


def _irradiance(scene: Scene, spot: Surface) -> Tensor:
    """Light that arrives at surfaces ``(n, 3)``: ambient, more from above, and all lamps in sight."""
    light = scene.ambient * (1 - 0.25 * spot.normal[:, 1:2])
    casters = scene.primitives.shadow_casters
    for position, color, reach in zip(
        scene.lamps.position, scene.lamps.color, scene.lamps.reach, strict=True
    ):
        ray = spot.position - position
        distance = ray.norm(dim=-1)
        ray = ray / distance[:, None]
        slant = -(spot.normal * ray).sum(-1)
        lit = (slant > 0).nonzero()[:, 0]
        hidden = occluded(casters, position, ray[lit], distance[lit] - SHADOW_GAP)
        strength = torch.zeros_like(slant)
        strength[lit] = slant[lit] * ~hidden / (reach**2 + distance[lit].square())
        light = light + strength[:, None] * color
    return light
