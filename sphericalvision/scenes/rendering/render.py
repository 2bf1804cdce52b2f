# SPDX-License-Identifier: Apache-2.0
"""Pictures and exact depth of a scene, through any camera.

Light is Lambert shading by point lamps that cast shadows, plus ambient light; mirrors show one reflection.
Colours are computed in linear light and become a picture by the scene's exposure and a display curve (power 1
/ 2.2).
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sphericalvision.cameras import Camera, CameraRig
from sphericalvision.cameras.base import check_single
from sphericalvision.core import ArgumentError, check_last_dim, check_tensor, check_type
from sphericalvision.kernels import full_precision
from sphericalvision.scenes.rendering.mesh_scene import MeshScene
from sphericalvision.scenes.rendering.ray_packets import RAYS, RayPackets, packed
from sphericalvision.scenes.rendering.raycast import chunk_size, trace
from sphericalvision.scenes.rendering.scene import Scene
from sphericalvision.scenes.rendering.shading import SurfaceTable, radiance


@full_precision
@torch.no_grad()
def ray_depth(
    scene: Scene | MeshScene, origin: Float[Tensor, " 3"], directions: Float[Tensor, "*rays 3"]
) -> Float[Tensor, "*rays"]:
    """Exact distances from a point along rays.

    Args:
        scene: primitives, or a mesh.
        origin: ``(3,)`` metres, for example ``rig.center``.
        directions: ``(*, 3)`` unit directions of any grid, for example ``Icosphere(5).vertices``; it is fast where
            neighbours in the tensor are neighbours on the sphere.

    Returns:
        Metres along each ray ``(*)``; inf where the ray leaves the scene.

    Examples:
        >>> from sphericalvision.scenes.procedural import make_scene
        >>> depth = ray_depth(make_scene("room", seed=0), torch.zeros(3), torch.tensor([[0.0, 1.0, 0.0]]))
        >>> bool(depth > 0.5)
        True
    """
    directions = directions.to(scene.device, torch.float32)
    if isinstance(scene, MeshScene):
        return scene.trace(origin, directions.reshape(-1, 3))[0].view(directions.shape[:-1])
    return trace(scene.primitives, origin.to(directions), directions).distance


@full_precision
@torch.no_grad()
def ray_labels(
    scene: Scene, origin: Float[Tensor, " 3"], directions: Float[Tensor, "*rays 3"]
) -> Int[Tensor, "*rays"]:
    """What rays from a point hit, as numbers of ``SURFACE_LABELS``: labels for semantic segmentation.

    Args:
        scene: primitives; ``make_scene("room")`` names all its surfaces.
        origin: ``(3,)`` metres.
        directions: ``(*, 3)`` unit directions of any grid.

    Returns:
        ``(*)``, -1 where the ray leaves the scene.

    Raises:
        ArgumentError: a mesh, whose surfaces have no names.

    Examples:
        >>> from sphericalvision.scenes import SURFACE_LABELS, make_scene
        >>> up_and_down = torch.tensor([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
        >>> labels = ray_labels(make_scene("room", seed=0), torch.zeros(3), up_and_down)
        >>> [SURFACE_LABELS[label] for label in labels]
        ['ceiling', 'floor']
    """
    if isinstance(scene, MeshScene):
        raise ArgumentError("scene: surfaces of meshes have no names; labels are of generated scenes")
    directions = directions.to(scene.device, torch.float32)
    hit = trace(scene.primitives, origin.to(directions), directions).primitive
    return torch.where(hit < 0, -1, scene.primitives.label[hit.clamp(min=0)])


@full_precision
@torch.no_grad()
def render_directions(
    scene: Scene | MeshScene,
    origin: Float[Tensor, " 3"],
    directions: Float[Tensor, "*rays 3"],
    spread: float | Float[Tensor, " ..."] | None = None,
) -> Float[Tensor, " 3 *rays"]:
    """Colours seen from a point along rays.

    Args:
        scene: primitives, or a mesh.
        origin: ``(3,)`` metres.
        directions: ``(*, 3)`` unit directions.
        spread: angle in radians between neighbouring rays, a number or ``(*)``: textures are averaged over
            it.
            None: as if the rays covered the sphere evenly.

    Returns:
        ``(3, *)`` in [0, 1].

    Examples:
        >>> from sphericalvision.scenes import make_scene
        >>> from sphericalvision.icosphere import Icosphere
        >>> render_directions(make_scene("room"), torch.zeros(3), Icosphere(2).vertices).shape
        torch.Size([3, 162])
    """
    check_type("scene", scene, (Scene, MeshScene), "make_scene makes one")
    check_last_dim("directions", directions, 3)
    directions = directions.to(scene.device, torch.float32)
    if spread is None:
        spread = (4 * torch.pi / max(1, directions.numel() // 3)) ** 0.5
    shape = directions.shape[:-1]
    rays = directions.reshape(-1, 3).T.contiguous()
    spread = torch.as_tensor(spread).to(directions).expand(shape).reshape(-1)
    light = _exposed(scene, origin.to(directions), packed(rays), packed(spread))
    return _develop(light.flatten(1)[:, : rays.shape[1]]).view(3, *shape)


@full_precision
@torch.no_grad()
def render_camera(
    scene: Scene | MeshScene,
    camera: Camera,
    world_from_camera: Float[Tensor, "4 4"],
    samples_per_pixel: int = 1,
) -> Float[Tensor, "3 h w"]:
    """The picture that one camera takes.

    Args:
        scene: primitives, or a mesh.
        camera: any camera (not batched).
        world_from_camera: its pose ``(4, 4)``.
        samples_per_pixel: stratified rays through each pixel; a pixel is the mean over those that the camera
            sees.

    Returns:
        ``(3, h, w)`` in [0, 1]; 0 where the camera sees nothing.

    Examples:
        >>> from sphericalvision.cameras import FisheyeCamera
        >>> from sphericalvision.scenes import make_scene
        >>> camera = FisheyeCamera.from_field_of_view((16, 16), 3.5)
        >>> picture = render_camera(make_scene("room"), camera, torch.eye(4))
        >>> picture.shape, picture[:, 0, 0].tolist()  # a corner lies outside the field of view
        (torch.Size([3, 16, 16]), [0.0, 0.0, 0.0])
    """
    check_type("scene", scene, (Scene, MeshScene), "make_scene makes one")
    check_type("camera", camera, Camera)
    check_tensor("world_from_camera", world_from_camera, "(4, 4)")
    return _pictures(scene, camera, world_from_camera[None], samples_per_pixel)[0]


def _pictures(
    scene: Scene | MeshScene, camera: Camera, world_from_camera: Tensor, samples_per_pixel: int
) -> Tensor:
    """The pictures ``(n, 3, h, w)`` from poses ``(n, 4, 4)`` of one camera, whose pixels are made rays once."""
    if samples_per_pixel < 1:
        raise ArgumentError(f"samples_per_pixel: expected at least 1, got {samples_per_pixel}")
    poses = world_from_camera.to(scene.device, torch.float32)
    height, width = camera.image_size
    squares = _squares(height, width).to(scene.device)
    total = torch.zeros(len(poses), 3, height * width, device=scene.device)
    count = torch.zeros(height * width, device=scene.device)
    sample = torch.zeros_like(total)
    for offset in _stratified(samples_per_pixel):
        seen = camera.unproject(camera.pixel_grid(torch.float32) + offset)
        valid = seen.valid.flatten().to(scene.device)
        local = seen.directions.to(scene.device, torch.float32)
        pixels = _seen(squares, valid)
        rays = local.reshape(-1, 3).T.index_select(1, pixels.flatten())
        spread = _spread(local).flatten()[pixels] / samples_per_pixel**0.5
        for pose, values in zip(poses, sample, strict=True):
            directions = (pose[:3, :3] @ rays).view(3, *pixels.shape)
            # Of brighter samples the mean of a pixel would show little else.
            light = _exposed(scene, pose[:3, 3], directions, spread).clamp_(max=4)
            # Squares at edges hold pixels twice, with the same light.
            values.scatter_(1, pixels.flatten().expand(3, -1), light.flatten(1))
        # A pixel that this sample misses still has the light of the last.
        total.addcmul_(sample, valid.to(sample))
        count += valid
    picture = _develop(total / count.clamp(min=1))
    return picture.view(-1, 3, height, width)


@full_precision
@torch.no_grad()
def render_rig(
    scene: Scene | MeshScene, rig: CameraRig, samples_per_pixel: int = 1
) -> dict[str, Float[Tensor, "3 _ _"]]:
    """The pictures that all cameras of a rig take: name -> ``(3, h, w)`` in [0, 1]; see `render_camera`.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.scenes import make_scene
        >>> list(render_rig(make_scene("room"), ring_rig(2, image_size=(16, 16))))
        ['cam1', 'cam2']
    """
    check_type("scene", scene, (Scene, MeshScene), "make_scene makes one")
    check_type("rig", rig, CameraRig, "ring_rig makes one, read_rig reads one")
    check_single(rig)
    cameras = list(rig.cameras.values())
    pictures: dict[int, Tensor] = {}
    for camera in {id(camera): camera for camera in cameras}.values():  # most rigs have one in all places
        indices = [place for place, other in enumerate(cameras) if other is camera]
        images = _pictures(scene, camera, rig.world_from_camera[indices], samples_per_pixel)
        pictures |= dict(zip(indices, images, strict=True))
    return {name: pictures[place] for place, name in enumerate(rig.names)}


def _develop(light: Tensor) -> Tensor:
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


def _squares(height: int, width: int) -> Tensor:
    """Numbers of the pixels in squares of `RAYS`, ``(s, RAYS)``; those at the edges hold the last pixels repeatedly."""
    side = math.isqrt(RAYS)
    rows, columns = (
        torch.arange(-(-size // side) * side).clamp(max=size - 1).view(-1, side) for size in (height, width)
    )
    return (rows[:, None, :, None] * width + columns[None, :, None, :]).reshape(-1, RAYS)


def _seen(squares: Tensor, valid: Tensor) -> Tensor:
    """The squares with any valid pixel; in each the first of these stands in for the others."""
    inside = valid[squares]
    some = inside.any(1).nonzero()[:, 0]
    squares, inside = squares[some], inside[some]
    return torch.where(inside, squares, squares.gather(1, inside.int().argmax(1, keepdim=True)))


def _exposed(scene: Scene | MeshScene, origin: Tensor, direction: Tensor, spread: Tensor) -> Tensor:
    """Exposed linear light ``(3, b, RAYS)`` along packed rays ``(3, b, RAYS)`` from one point."""
    if isinstance(scene, MeshScene):
        return (scene.light(origin, direction.flatten(1).T) * scene.exposure).T.reshape(direction.shape)
    table, size = SurfaceTable.of(scene), chunk_size(direction.device)
    light = torch.empty_like(direction)
    for start in range(0, direction.shape[1], size):
        chunk = slice(start, start + size)
        rays = RayPackets(origin[:, None, None], direction[:, chunk].contiguous())
        light[:, chunk] = radiance(scene, table, rays, spread[chunk])
    return light * scene.exposure
