# SPDX-License-Identifier: Apache-2.0
"""A scene of primitives as triangles, with the light that leaves them as colours of the vertices."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from sphericalvision.core import ArgumentError
from sphericalvision.scenes.rendering.primitives import SHAPES
from sphericalvision.scenes.rendering.ray_packets import RayPackets, packed
from sphericalvision.scenes.rendering.raycast import chunk_size
from sphericalvision.scenes.rendering.scene import Scene
from sphericalvision.scenes.rendering.shading import SurfaceTable, radiance

if TYPE_CHECKING:
    import trimesh

__all__ = ["mesh_from_scene"]

Triangles = tuple[Tensor, Tensor]
"""Vertices ``(v, 3)`` and faces ``(f, 3)``."""

#: How far in front of a surface its light is gathered (metres).
LIFT = 5e-3
#: Sides of the polygons that stand for circles.
AROUND = 96


@torch.no_grad()
def mesh_from_scene(scene: Scene, detail: float = 0.1, most: int = 64) -> trimesh.Trimesh:
    """Turn a scene into one mesh with coloured vertices, y up, as glTF wants it; ``.export("room.glb")`` writes it.

    Light, shadows and textures are in the colours, as fine as the triangles; mirrors are matt. Balls and cylinders are
    polyhedra inside of the true shapes, off by less than a thousandth of their size.

    Args:
        scene: the scene.
        detail: metres between vertices of flat surfaces.
        most: largest number of squares along one side of a flat surface, however large.

    Raises:
        ArgumentError: a detail that is not positive, or no squares.

    Examples:
        >>> from sphericalvision.scenes import make_scene
        >>> mesh_from_scene(make_scene("floating", seed=1), detail=1.0, most=2).vertices.shape[1]
        3
    """
    import trimesh

    if not detail > 0 or most < 1:
        raise ArgumentError(f"detail, most: expected metres above 0 and 1 or more, got {detail} and {most}")
    scene, primitives = scene.to("cpu"), scene.to("cpu").primitives
    points, normals, faces, count = [], [], [], 0
    for row in range(len(primitives)):
        half, turn = primitives.half[row], primitives.rotation[row]
        for vertices, triangles in _unit_shape(SHAPES[int(primitives.shape[row])], half, detail, most):
            local = vertices * half
            first, second, third = local[triangles].unbind(1)
            outward = torch.linalg.cross(second - first, third - first)
            at_vertices = torch.zeros_like(local).index_add_(
                0, triangles.flatten(), outward.repeat_interleave(3, 0)
            )
            points.append(local @ turn + primitives.center[row])
            normals.append(torch.nn.functional.normalize(at_vertices, dim=-1) @ turn)
            faces.append(triangles + count)
            count += len(vertices)
    position, normal = torch.cat(points), torch.cat(normals)
    # A rectangle shows the same texture from both sides; its front is the one that the scene's middle sees.
    light = _leaving(scene, position, _towards(normal, position), detail)
    colors = ((light * scene.exposure).clamp(0, 1) ** (1 / 2.2) * 255).round().to(torch.uint8)
    upright = position.double().numpy() * np.array([1.0, -1.0, -1.0])
    return trimesh.Trimesh(upright, torch.cat(faces).numpy(), vertex_colors=colors.numpy(), process=False)


def _towards(normal: Tensor, position: Tensor) -> Tensor:
    """Normals ``(n, 3)``, turned round where they look away from the origin, around which scenes are built."""
    return torch.where(((normal * position).sum(-1, keepdim=True) > 0), -normal, normal)


def _leaving(scene: Scene, position: Tensor, normal: Tensor, detail: float) -> Tensor:
    """Linear light ``(n, 3)`` that leaves surfaces towards their normals, averaged over ``detail`` metres."""
    origin = packed((position + LIFT * normal).T.contiguous())
    direction = packed(-normal.T.contiguous())
    spread = torch.full_like(origin[0], detail / LIFT)
    table, size = SurfaceTable.of(scene), chunk_size(direction.device)
    light = torch.empty_like(direction)
    for start in range(0, direction.shape[1], size):
        part = slice(start, start + size)
        rays = RayPackets(origin[:, part].contiguous(), direction[:, part].contiguous())
        light[:, part] = radiance(scene, table, rays, spread[part], bounces=0)
    return light.flatten(1).T[: len(position)]


def _unit_shape(shape: str, half: Tensor, detail: float, most: int) -> list[Triangles]:
    """Triangles of a unit shape, in pieces between which normals are not smoothed."""
    import trimesh

    x, y, z = (min(most, max(1, math.ceil(2 * side / detail))) for side in half.tolist())
    if shape == "rectangle":
        return [_grid(x, y)]
    if shape == "box":
        pieces = []
        for axis, (rows, columns) in enumerate(((y, z), (z, x), (x, y))):
            for side in (-1.0, 1.0):
                flat, faces = _grid(rows, columns)
                flat = torch.stack([side * torch.ones(len(flat)), side * flat[:, 0], flat[:, 1]], -1)
                pieces.append((flat.roll(axis, -1), faces))
        return pieces
    if shape == "ellipsoid":
        ball = trimesh.creation.icosphere(subdivisions=4)
        return [(torch.from_numpy(np.array(ball.vertices)).float(), torch.from_numpy(np.array(ball.faces)))]
    return _cylinder(y)


def _grid(rows: int, columns: int) -> Triangles:
    """The square [-1, 1]² at z = 0, its front towards +z."""
    u, v = torch.meshgrid(torch.linspace(-1, 1, rows + 1), torch.linspace(-1, 1, columns + 1), indexing="ij")
    vertices = torch.stack([u, v, torch.zeros_like(u)], -1).flatten(0, 1)
    first = (torch.arange(rows)[:, None] * (columns + 1) + torch.arange(columns)).flatten()
    corners = first, first + columns + 1, first + columns + 2, first + 1
    a, b, c, d = corners
    return vertices, torch.cat([torch.stack([a, b, c], -1), torch.stack([a, c, d], -1)])


def _cylinder(rings: int) -> list[Triangles]:
    """The side of the unit cylinder as a rolled-up grid, and its two caps as fans."""
    flat, faces = _grid(rings, AROUND)
    angle = math.pi * flat[:, 1]
    side = torch.stack([angle.sin(), flat[:, 0], angle.cos()], -1)
    rim = torch.arange(AROUND) * (2 * math.pi / AROUND)
    fan = torch.stack(
        [torch.zeros(AROUND).long(), torch.arange(1, AROUND + 1), torch.arange(1, AROUND + 1).roll(-1)], -1
    )
    caps: list[Triangles] = []
    for y in (-1.0, 1.0):
        edge = torch.stack([rim.sin(), torch.full_like(rim, y), rim.cos()], -1)
        center = torch.tensor([[0.0, y, 0.0]])
        caps.append((torch.cat([center, edge]), fan if y > 0 else fan.flip(-1)))
    return [(side, faces), *caps]
