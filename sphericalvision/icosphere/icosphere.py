# SPDX-License-Identifier: Apache-2.0
"""``Icosphere``: the module that owns the vertices and faces of one level."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.geometry.directions import check_directions, in_single_precision, moderate_lengths
from sphericalvision.geometry.lookup import weighted_sums
from sphericalvision.icosphere.adjacency import icosphere_edges, icosphere_neighbors
from sphericalvision.icosphere.areas import icosphere_solid_angles
from sphericalvision.icosphere.locator import locate
from sphericalvision.icosphere.mesh import icosphere_vertices
from sphericalvision.icosphere.subdivision import subdivision_order
from sphericalvision.icosphere.topology import coarse_vertex_ids, icosphere_faces, num_icosphere_vertices
from sphericalvision.shapes import check_shapes


class Icosphere(nn.Module):
    """A subdivided icosahedron as a grid of directions, with values on its ``2 + 10 * 4**level`` vertices.

    Convention:
        x right, y down, z forward; vertex 0 is the north pole (0, -1, 0), the last vertex is the south pole
        (0, 1, 0). In between, five charts of ``2**(level + 1)`` rows and ``2**level`` columns follow row by
        row, so a coarser level is a strided slice. Vertices are those of midpoint subdivision, projected
        onto the sphere at each level.

    Args:
        level: number of subdivisions; 0 is the icosahedron, 7 has 163,842 vertices.
        dtype: of the vertices; the default dtype of torch when not given.
        device: of all tables.

    Attributes:
        level: the level given.
        num_vertices: V.
        vertices: ``(V, 3)`` unit vectors.
        faces: ``(F, 3)`` vertex ids, counter-clockwise seen from outside.

    Examples:
        >>> ico = Icosphere(3)
        >>> ico
        Icosphere(level=3, vertices=642, faces=1280)
        >>> ico.sample(-ico.vertices[:, 1], torch.tensor([[0.0, -1.0, 0.0]]))  # the height, straight up
        tensor([1.])
    """

    vertices: Tensor
    faces: Tensor

    def __init__(
        self, level: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> None:
        super().__init__()
        self.num_vertices = num_icosphere_vertices(level)
        self.level = level
        self.register_buffer("vertices", icosphere_vertices(level, dtype, device), persistent=False)
        self.register_buffer("faces", icosphere_faces(level, device), persistent=False)

    @property
    def shape(self) -> tuple[int]:
        """Shape of values on this grid, ``(V,)``."""
        return (self.num_vertices,)

    @property
    def directions(self) -> Float[Tensor, "V 3"]:
        """Directions of the grid, the vertices ``(V, 3)``."""
        return self.vertices

    @property
    def solid_angles(self) -> Float[Tensor, " V"]:
        """Solid angle of each vertex ``(V,)`` in steradians: a third of each spherical triangle around it."""
        return icosphere_solid_angles(self.level, self.vertices.dtype, self.vertices.device)

    @property
    def neighbors(self) -> Int[Tensor, "V 6"]:
        """Neighbours of each vertex ``(V, 6)``, counter-clockwise from outside; -1 last where only five."""
        return icosphere_neighbors(self.level, self.vertices.device)

    @property
    def edges(self) -> Int[Tensor, "E 2"]:
        """Pairs of neighbouring vertices ``(E, 2)``, each edge once."""
        return icosphere_edges(self.level, self.vertices.device)

    @property
    def subdivision_order(self) -> Int[Tensor, " V"]:
        """Index of each vertex ``(V,)`` in the order of plain midpoint subdivision."""
        return subdivision_order(self.level, self.vertices.device)

    @property
    def coarse_ids(self) -> Int[Tensor, " V_coarse"]:
        """Ids in this icosphere of the vertices of ``coarser()``, in their order."""
        return coarse_vertex_ids(self.level, self.vertices.device)

    def coarser(self) -> Icosphere:
        """Return the icosphere of one level less, of the same dtype and on the same device."""
        if self.level == 0:
            raise ArgumentError("Icosphere.coarser: level 0 is the icosahedron, there is no coarser level")
        return Icosphere(self.level - 1, self.vertices.dtype, self.vertices.device)

    def finer(self) -> Icosphere:
        """Return the icosphere of one level more, of the same dtype and on the same device."""
        return Icosphere(self.level + 1, self.vertices.dtype, self.vertices.device)

    def locate(
        self, directions: Float[Tensor, "*batch 3"]
    ) -> tuple[Int[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
        """Return ids ``(*, 3)`` and barycentric weights ``(*, 3)`` of the triangle each direction pierces.

        The function ``locate`` of this package; weights are differentiable in the directions ``(*, 3)``.
        """
        return locate(directions, self.level)

    def nearest(self, directions: Float[Tensor, "*batch 3"]) -> Int[Tensor, "*batch"]:
        """Return the id ``(*)`` of the vertex nearest to each direction ``(*, 3)``.

        All triangles are acute, so the nearest vertex is a corner of the containing triangle.

        Examples:
            >>> Icosphere(2).nearest(torch.tensor([0.0, -1.0, 0.01]))
            tensor(0)
        """
        check_directions(directions)
        ids, _ = locate(directions, self.level)
        unit = torch.nn.functional.normalize(moderate_lengths(directions), dim=-1)
        distances = (self.vertices[ids] - unit[..., None, :]).square().sum(-1)
        return ids.gather(-1, distances.argmin(-1, keepdim=True)).squeeze(-1)

    @check_shapes
    def sample(
        self, values: Float[Tensor, "*channels V"], directions: Float[Tensor, "*batch n 3"]
    ) -> Float[Tensor, "*result n"]:
        """Interpolate values on the vertices linearly in each triangle.

        Args:
            values: ``(*b, c, V)``, or ``(V,)`` for a single channel.
            directions: ``(*b, n, 3)``, or ``(n, 3)`` for all of the batch.

        Returns:
            ``(*b, c, n)``, or ``(n,)`` for values ``(V,)``; differentiable in both arguments.
        """
        if values.shape[-1] != self.num_vertices:
            raise ShapeError(
                f"values: expected shape (*b, c, {self.num_vertices}) for an icosphere of level "
                f"{self.level}, got {tuple(values.shape)}"
            )
        ids, weights = self.locate(in_single_precision(directions))
        if values.ndim == 1:
            return weighted_sums(values[None], ids, weights)[..., 0, :]
        return weighted_sums(values, ids, weights)

    def extra_repr(self) -> str:
        return f"level={self.level}, vertices={self.num_vertices}, faces={len(self.faces)}"
