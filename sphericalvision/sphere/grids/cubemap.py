# SPDX-License-Identifier: Apache-2.0
"""The cube map: six square perspective images of 90°, interpolated across edges and corners."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sphericalvision.core import check_counts, check_floating, check_last_dim
from sphericalvision.geometry.directions import (
    check_directions,
    components,
    from_components,
    has_numbers,
    moderate_lengths,
    safe_sqrt,
)
from sphericalvision.sphere.grids.cube_layouts import CUBE_FACES, world_from_cube_face
from sphericalvision.sphere.grids.cube_padding import faces_continued
from sphericalvision.sphere.grids.mosaic import mosaic, mosaic_pixels, tile_samples
from sphericalvision.sphere.grids.sphere_grid import GridModule, check_cells, check_values


class Cubemap(GridModule):
    """Six faces of ``size`` x ``size`` pixels, each a perspective image of 90° seen from the centre.

    Convention:
        Values are ``(*b, c, 6, size, size)``, faces in the order front (+z), right (+x), back (-z), left (-x), up
        (-y), down (+y). Rows grow downwards; the lower edge of the upper face and the upper edge of the lower face
        meet the front face. Pixel centres are half a pixel away from the edges: the centre of column i lies at the
        tangent (2i + 1) / size - 1.

    Interpolation continues across edges and corners. Near an edge it is bilinear in the plane across the edge, in
    which the outermost pixels of both faces form one rectangular lattice; where three faces meet it is linear in the
    triangle of their corner pixels. So it is continuous and second order everywhere.

    Args:
        size: pixels along an edge.
        dtype: of the directions; the default dtype of torch when not given.
        device: of all tables.

    Raises:
        ArgumentError: if the size is not a positive integer, or too large.

    Examples:
        >>> grid = Cubemap(3)
        >>> grid
        Cubemap(size=3)
        >>> grid.directions[1, 1, 1]  # the middle of the right face
        tensor([1., 0., 0.])
    """

    def __init__(
        self, size: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> None:
        super().__init__()
        check_counts(size=size)
        check_cells(6 * size**2, size=size)
        self.size = size
        self._make_directions(dtype, device)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of values on this grid, ``(6, size, size)``."""
        return (6, self.size, self.size)

    @property
    def faces(self) -> tuple[str, ...]:
        """Names of the faces in their order."""
        return CUBE_FACES

    @property
    def solid_angles(self) -> Float[Tensor, "6 size size"]:
        """Exact solid angle of each pixel ``(6, size, size)`` in steradians."""
        edge = torch.linspace(-1, 1, self.size + 1, dtype=torch.float64)
        x, y = torch.meshgrid(edge, edge, indexing="ij")
        from_center = torch.atan2(x * y, (x * x + y * y + 1).sqrt())  # of the rectangle (0, 0) to (x, y)
        face = from_center.diff(dim=0).diff(dim=1)
        return face.to(self.directions).expand(self.shape)

    def cell_samples(
        self, samples: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> tuple[Float[Tensor, "P k 3"], Float[Tensor, "#P k"]]:
        """Directions ``(6 * size**2, samples**2, 3)`` spread over each pixel, and their shares of its solid angle."""
        count = self.size * samples
        tangent = (2 * torch.arange(count, dtype=torch.float64, device=device) + 1 - count) / count
        frames = world_from_cube_face(torch.float64, device)
        return tile_samples(tangent.view(-1, samples), frames, dtype or self.directions.dtype)

    def face_coordinates(
        self, directions: Float[Tensor, "*batch 3"]
    ) -> tuple[Int[Tensor, "*batch"], Float[Tensor, "*batch 2"]]:
        """Face ``(*)`` that each direction ``(*, 3)`` goes through, and its tangents (x, y) ``(*, 2)`` there, -1 to 1.

        Examples:
            >>> face, tangents = Cubemap(4).face_coordinates(torch.tensor([3.0, 1.5, -0.75]))
            >>> face.item(), tangents
            (1, tensor([0.2500, 0.5000]))
        """
        check_last_dim("directions", directions, 3)
        x, y, z = components(moderate_lengths(directions))
        # Opposite faces have the same quotients, which leaves three kinds. On an edge the first of the faces is meant.
        sideways = (x.abs() > z.abs()) | ((x.abs() == z.abs()) & (x > z))
        level = torch.where(sideways, x, z)
        vertical = y.abs() > level.abs()
        right = torch.where(sideways & ~vertical, -z, x) / torch.where(vertical, y.abs(), level)
        down = torch.where(vertical, -z, y) / torch.where(vertical, y, level.abs())
        face = torch.where(vertical, 4 + (y > 0).long(), sideways.long() + 2 * (level < 0).long())
        return face, from_components(right, down)

    def nearest(self, directions: Float[Tensor, "*batch 3"]) -> Int[Tensor, "*batch"]:
        """Return the index ``(*)`` of the pixel that contains each direction ``(*, 3)``.

        Examples:
            >>> Cubemap(1).nearest(torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.1]])).tolist()
            [0, 5]
        """
        check_directions(directions)
        face, tangents = self.face_coordinates(directions)
        column, row = ((tangents + 1) * (self.size / 2)).floor().long().clamp(0, self.size - 1).unbind(-1)
        return (face * self.size + row) * self.size + column

    def padded(
        self, values: Float[Tensor, "*batch c 6 size size"]
    ) -> Float[Tensor, "*batch c 6 size+2 size+2"]:
        """Faces with a ring of the pixels across their edges, ``(*b, c, 6, size + 2, size + 2)``; see ``cube_pad``."""
        check_values(values, self.shape)
        return faces_continued(values, (1, 1, 1, 1))

    def image(self, values: Float[Tensor, "*batch c 6 size size"]) -> Float[Tensor, "*batch c h w"]:
        """One image ``(*b, c, h, w)`` of the padded faces, in which ``image_pixels`` are meant."""
        return mosaic(self.padded(values))

    def image_pixels(self, directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """Pixels (u, v) ``(*, 2)`` of ``image`` at which bilinear interpolation gives the value of each direction.

        Differentiable in the directions ``(*, 3)``.
        """
        check_floating("directions", directions)
        face, tangents = self.face_coordinates(directions)
        return mosaic_pixels(face, _lattice(tangents, self.size) + 1, 6, self.size + 2)

    def extra_repr(self) -> str:
        return f"size={self.size}"


def _lattice(tangents: Tensor, size: int) -> Tensor:
    """Pixel coordinates (*, 2) on a face and the ring around it, from tangents (*, 2).

    Across the edge x = 1 the ring's pixels are the mirror images of the face's own. In the plane x + z = 2 both lie
    on a rectangular lattice: there a point of this face is at 2 y / (x + 1) along the edge.
    """
    inside = (tangents + 1) * (size / 2) - 0.5
    outer = (tangents.abs() > 1 - 1 / size).any(-1)
    if not has_numbers(outer):
        return torch.where(outer.unsqueeze(-1), _across_edges(tangents, size), inside)
    outside = outer.nonzero(as_tuple=True)  # few
    return inside.index_put(outside, _across_edges(tangents[outside], size))


def _across_edges(tangents: Tensor, size: int) -> Tensor:
    """Of ``_lattice``, what lies beyond the centres of a face's outermost pixels."""
    half = 1 / size  # a pixel
    limit = 1 - half
    x, y = tangents.unbind(-1)

    def strip(across: Tensor, along: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        outward = across.abs()
        excess = 0.5 + (outward - 1) * ((2 - half) / (2 * half)) / (outward + 1)
        along = along * (2 - half) / (outward + 1)
        continued = torch.where(across < 0, -excess, size - 1 + excess)
        return (outward > limit) & (along.abs() <= limit), continued, (along + 1) * (size / 2) - 0.5

    sideways, u_sideways, v_sideways = strip(x, y)
    below, v_below, u_below = strip(y, x)
    a, b = _corner_shares(x.abs(), y.abs(), limit)
    u_corner, v_corner = torch.where(x < 0, -a, size - 1 + a), torch.where(y < 0, -b, size - 1 + b)
    u = torch.where(sideways, u_sideways, torch.where(below, u_below, u_corner))
    v = torch.where(sideways, v_sideways, torch.where(below, v_below, v_corner))
    return torch.stack((u, v), -1)


def _corner_shares(x: Tensor, y: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """Steps (a, b) from a face's corner pixel that give the weights of the triangle of three corner pixels.

    The triangle's corners are (l, l, 1), (1, l, l) and (l, 1, l). With the mean of the latter two in the ring's
    corner, their bilinear weights are (1 - a)(1 - b), a - ab/2 and b - ab/2.
    """
    # Solve p = f (l, l, 1) + g (1, l, l) + h (l, 1, l), then scale so that f + g + h = 1.
    total = (x + y + 1) / (1 + 2 * limit)
    own, right, below = ((value / total - limit) / (1 - limit) for value in (torch.ones_like(x), x, y))
    difference = right - below
    mean = (difference + safe_sqrt(difference * difference + 4 * own)) / 2
    return 1 - mean + difference, 1 - mean
