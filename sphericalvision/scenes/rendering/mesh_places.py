# SPDX-License-Identifier: Apache-2.0
"""Where in a mesh a rig may stand: free places, each of which is a scene of its own."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import Icosphere
from sphericalvision.scenes.rendering.mesh_scene import MeshScene

__all__ = ["PlacedMesh", "free_place"]

TRIES = 500
#: Share of all directions in which something must be, for a place to count as inside of what was scanned.
ENCLOSED = 0.4
#: Share of the directions more than 30° down in which something must be, for a place to count as above ground.
GROUNDED = 0.9


class PlacedMesh(MeshScene):
    """A mesh moved so that a place in it lies where the rig is, and turned about the vertical there.

    Args:
        mesh: shared by all places in it; nothing is copied.
        place: ``(3,)`` metres in the mesh's own world.
        yaw: radians by which the rig looks further to the right.
        center: ``(3,)`` where the rig's centre is, metres; the origin when not given.

    Examples:
        >>> import trimesh
        >>> from sphericalvision.scenes import ray_depth
        >>> room = MeshScene(trimesh.creation.box((4.0, 3.0, 6.0)))  # doctest: +SKIP
        >>> to_the_right = PlacedMesh(room, torch.tensor([1.0, 0.0, 0.0]), 0.0)  # doctest: +SKIP
        >>> ray_depth(to_the_right, torch.zeros(3), torch.tensor([[1.0, 0.0, 0.0]]))  # doctest: +SKIP
        tensor([1.])
    """

    def __init__(
        self,
        mesh: MeshScene,
        place: Float[Tensor, " 3"],
        yaw: float = 0.0,
        center: Float[Tensor, " 3"] | None = None,
    ) -> None:
        self.mesh, self.place = mesh, place
        self.center = torch.zeros(3) if center is None else center.detach().cpu().float()
        self.exposure, self.background = mesh.exposure, mesh.background
        sin, cos = math.sin(yaw), math.cos(yaw)
        self.mesh_from_world = torch.tensor([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])

    def trace(
        self, origin: Float[Tensor, " 3"], directions: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, " n"], Int[Tensor, " n"]]:
        """First triangle along each ray; see ``MeshScene.trace``."""
        return self.mesh.trace(self._point(origin), directions @ self.mesh_from_world.T)

    def light(self, origin: Float[Tensor, " 3"], directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Linear colours ``(n, 3)`` along rays ``(n, 3)``; see ``MeshScene.light``."""
        return self.mesh.light(self._point(origin), directions @ self.mesh_from_world.T)

    def _point(self, origin: Tensor) -> Tensor:
        return self.place + self.mesh_from_world @ (origin.detach().cpu().float() - self.center)


def free_place(
    mesh: MeshScene, seed: int, clear_radius: float = 0.6, center: Float[Tensor, " 3"] | None = None
) -> PlacedMesh:
    """A place in a mesh, drawn at random, that is free around it and has something on enough sides.

    Places are drawn evenly from the box that bounds the mesh; the first is taken that has no triangle nearer than
    ``clear_radius`` in any of 642 directions, hits one in two of five, and in nine of ten of those that look more than
    30° down: a rig stands above ground, not under it or beside the mesh. Where no place drawn has ground, as among
    objects alone, the first that has the other two is taken. The yaw is drawn as well.

    Args:
        mesh: y down, metres.
        seed: the same seed finds the same place.
        clear_radius: metres.
        center: ``(3,)`` where the rig's centre is, metres; the origin when not given.

    Raises:
        ArgumentError: there is no such place among 500 that are drawn.
    """
    generator = torch.Generator().manual_seed(seed)
    vertices = torch.from_numpy(mesh.vertices).float()
    low, high = vertices.amin(0), vertices.amax(0)
    directions = Icosphere(3).vertices
    down = directions[:, 1] > 0.5
    nearest, groundless = 0.0, None
    for _ in range(TRIES):
        place = low + (high - low) * torch.rand(3, generator=generator)
        yaw = 2 * math.pi * torch.rand((), generator=generator).item()
        distance, _ = mesh.trace(place, directions)
        clear = distance.min().item()
        met = distance.isfinite().float()
        if clear >= clear_radius and met.mean() >= ENCLOSED:
            placed = PlacedMesh(mesh, place, yaw, center)
            if met[down].mean() >= GROUNDED:
                return placed
            groundless = groundless or placed
        nearest = max(nearest, clear if math.isfinite(clear) else 0.0)
    if groundless is not None:
        return groundless
    size = " x ".join(f"{side:.2f}" for side in (high - low).tolist())
    raise ArgumentError(
        f"mesh: no place for a rig with {clear_radius:.2f} m of free space around it, {nearest:.2f} m was the most; "
        f"the mesh is {size} m large (x, y, z): is its scale in metres, and its up axis right?"
    )
