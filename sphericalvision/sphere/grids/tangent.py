# SPDX-License-Identifier: Apache-2.0
"""Tangent images: a perspective patch on every face of a coarse icosphere."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from sphericalvision.cameras import PinholeCamera
from sphericalvision.core import ArgumentError, check_counts, check_last_dim
from sphericalvision.geometry.directions import check_directions, moderate_lengths
from sphericalvision.icosphere import TriangleLocator, icosphere_faces, icosphere_vertices
from sphericalvision.icosphere.topology import check_level
from sphericalvision.kernels import full_precision
from sphericalvision.sphere.grids.mosaic import mosaic, mosaic_pixels, tile_samples
from sphericalvision.sphere.grids.sphere_grid import GridModule, check_cells, check_values


class TangentImages(GridModule):
    """Gnomonic images that touch the sphere at the middle of each face of an icosphere.

    Within a patch the distortion stays small, so a network for ordinary images can look at one patch after the other.

    Convention:
        Values are ``(*b, c, patches, size, size)``, patches in the order of ``icosphere_faces(base_level)``. Columns
        grow to the right (east), rows downwards (south); all patches have the same scale. The outermost pixel centres
        lie ``margin`` pixels beyond the bounding box of the largest face.

    Patches overlap. A direction belongs to the face that contains it, and is read from this face's patch alone: so each
    value of ``sample`` comes from one perspective image, and constants stay constants. The solid angle of a pixel is
    that of its part inside its own face: zero in the margins, and 4π in sum.

    Args:
        base_level: level of the icosphere; 0 has 20 patches, 1 has 80, 2 has 320.
        size: pixels along a side of a patch, 2 or more.
        margin: pixels between a face and the outermost pixel centres; for filters that look beyond the face.
        dtype: of the directions; the default dtype of torch when not given.
        device: of all tables.

    Raises:
        ArgumentError: if the patches are too small for a face and its margin, or too large, or the level is negative.

    References:
        M. Eder et al. (2020), "Tangent images for mitigating spherical distortion", CVPR.

    Examples:
        >>> grid = TangentImages(0, 16)
        >>> grid
        TangentImages(base_level=0, size=16, margin=0, patches=20)
        >>> grid.sample(torch.ones(3, 20, 16, 16), torch.tensor([[0.0, -1.0, 0.0]])).shape
        torch.Size([3, 1])
    """

    def __init__(
        self,
        base_level: int,
        size: int,
        margin: float = 0.0,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        check_counts(size=size)
        if margin < 0 or size - 1 <= 2 * margin:
            raise ArgumentError(
                f"size: expected more than {1 + 2 * margin:g} pixels for a face and its margin of {margin:g} on either "
                f"side, got {size}"
            )
        self.base_level = base_level
        self.size = size
        self.margin = margin
        self.num_patches = 20 * 4 ** check_level(base_level)
        check_cells(self.num_patches * size**2, base_level=base_level, size=size)
        reach = _corners_in_plane(base_level, "cpu").abs().max().item()
        self.pixel_size = 2 * reach / (size - 1 - 2 * margin)
        self._make_directions(dtype, device)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of values on this grid, ``(patches, size, size)``."""
        return (self.num_patches, self.size, self.size)

    @property
    def world_from_patch(self) -> Float[Tensor, "patches 3 3"]:
        """Rotations ``(patches, 3, 3)`` whose columns are the right, down and forward axes of each patch."""
        return _frames(self.base_level, self.directions.device).to(self.directions)

    @property
    def camera(self) -> PinholeCamera:
        """The camera of which every patch is an image, in the frame of ``world_from_patch``."""
        focal_length = torch.tensor([1 / self.pixel_size] * 2, dtype=torch.float64)
        center = torch.full((2,), (self.size - 1) / 2, dtype=torch.float64)
        return PinholeCamera(focal_length, center, (self.size, self.size)).to(self.directions)

    @property
    def solid_angles(self) -> Float[Tensor, "patches size size"]:
        """Solid angle ``(patches, size, size)`` of each pixel's part inside its own face, in steradians."""
        corners = _corners_in_plane(self.base_level, self.directions.device)
        edges = torch.arange(self.size + 1, dtype=torch.float64, device=corners.device) - self.size / 2
        # Lines of pixels that run along an edge of a face are moved off it by a billionth of a pixel.
        edges = edges + 1e-9
        return solid_angles_in_triangle(edges * self.pixel_size, corners).to(self.directions)

    @property
    def cell_widths(self) -> Float[Tensor, "patches size size"]:
        """Square root of each whole pixel's solid angle ``(patches, size, size)``, in radians."""
        squared = self._side(self.size, self.directions.device) ** 2
        widths = self.pixel_size * (1 + squared + squared[:, None]) ** -0.75
        return widths.to(self.directions).expand(self.shape)

    def cell_samples(
        self, samples: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> tuple[Float[Tensor, "P k 3"], Float[Tensor, "#P k"]]:
        """Directions ``(n, samples**2, 3)`` spread over each whole pixel, and their shares of its solid angle."""
        side = self._side(self.size * samples, device).view(-1, samples)
        return tile_samples(side, _frames(self.base_level, device), dtype or self.directions.dtype)

    @full_precision
    def face_coordinates(
        self, directions: Float[Tensor, "*batch 3"]
    ) -> tuple[Int[Tensor, "*batch"], Float[Tensor, "*batch 2"]]:
        """Patch ``(*)`` whose face contains each direction ``(*, 3)``, and the pixel (u, v) ``(*, 2)`` there.

        Examples:
            >>> grid = TangentImages(0, 9)
            >>> patch, pixel = grid.face_coordinates(grid.directions[3, 4, 4])
            >>> patch.item(), pixel
            (3, tensor([4., 4.]))
        """
        check_last_dim("directions", directions, 3)
        directions = moderate_lengths(directions)
        columns = directions.detach().reshape(-1, 3).T.contiguous()
        faces, _ = TriangleLocator(self.base_level, columns.dtype, columns.device).find(columns)
        patch = faces.long().view(directions.shape[:-1])
        frames = _frames(self.base_level, directions.device).to(directions)
        x, y, z = (directions.unsqueeze(-2) @ frames[patch]).squeeze(-2).unbind(-1)
        # A direction lies in front of its own patch; the rest is for zero vectors.
        plane = torch.stack((x, y), -1) / torch.where(z > 0, z, 1.0).unsqueeze(-1)
        return patch, plane / self.pixel_size + (self.size - 1) / 2

    def nearest(self, directions: Float[Tensor, "*batch 3"]) -> Int[Tensor, "*batch"]:
        """Return the index ``(*)`` of the pixel, in the patch of the containing face, that each direction falls on."""
        check_directions(directions)
        patch, pixels = self.face_coordinates(directions)
        column, row = (pixels + 0.5).floor().long().clamp(0, self.size - 1).unbind(-1)
        return (patch * self.size + row) * self.size + column

    def image(self, values: Float[Tensor, "*batch c patches size size"]) -> Float[Tensor, "*batch c h w"]:
        """One image ``(*b, c, h, w)`` of all patches, in which ``image_pixels`` are meant."""
        check_values(values, self.shape)
        return mosaic(values)

    def image_pixels(self, directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """Pixels (u, v) ``(*, 2)`` of ``image`` at which bilinear interpolation gives the value of each direction.

        Differentiable in the directions ``(*, 3)``.
        """
        patch, pixels = self.face_coordinates(directions)
        return mosaic_pixels(patch, pixels, self.num_patches, self.size)

    def extra_repr(self) -> str:
        return f"base_level={self.base_level}, size={self.size}, margin={self.margin:g}, patches={self.num_patches}"

    def _side(self, count: int, device: torch.device | str | None) -> Tensor:
        """Coordinates (count,) of ``count`` places along a side, in the tangent plane."""
        offsets = 2 * torch.arange(count, dtype=torch.float64, device=device) + 1 - count
        return offsets / (2 * count) * (self.size * self.pixel_size)


def _frames(base_level: int, device: torch.device | str | None) -> Tensor:
    """Axes right, down, forward of each face as columns, (faces, 3, 3)."""
    corners = icosphere_vertices(base_level, torch.float64, device)[icosphere_faces(base_level, device)]
    forward = F.normalize(corners.sum(1), dim=-1)
    down = forward.new_tensor([0.0, 1.0, 0.0])  # never along the axis: the poles are vertices
    down = F.normalize(down - forward * forward[:, 1:2], dim=-1)
    return torch.stack((torch.linalg.cross(down, forward), down, forward), -1)


def _corners_in_plane(base_level: int, device: torch.device | str | None) -> Tensor:
    """Corners of each face in its tangent plane (faces, 3, 2)."""
    corners = icosphere_vertices(base_level, torch.float64, device)[icosphere_faces(base_level, device)]
    local = corners @ _frames(base_level, device)
    return local[..., :2] / local[..., 2:]


def solid_angles_in_triangle(
    edges: Float[Tensor, " ..."], corners: Float[Tensor, " ..."]
) -> Float[Tensor, "t k k"]:
    """Solid angle ``(t, k, k)`` of the part of each pixel that lies inside a triangle, in steradians.

    The boundary of that part is the pixel's edges inside the triangle and the triangle's edges inside the pixel. Each
    piece spans a triangle with the point where the plane touches the sphere; their signed solid angles add up.

    Args:
        edges: ``(k + 1,)`` where the pixels of a row end in the plane z = 1, and those of a column.
        corners: ``(t, 3, 2)`` of the triangles, from x to y around.

    Examples:
        >>> whole = torch.tensor([[[-9.0, -9.0], [9.0, -9.0], [0.0, 9.0]]], dtype=torch.float64)
        >>> angle = solid_angles_in_triangle(torch.tensor([-1.0, 1.0], dtype=torch.float64), whole)
        >>> round((angle / torch.pi).item(), 6)  # a face of the cube is a sixth of 4π
        0.666667
    """
    low, high = edges[:-1], edges[1:]
    y_low, x_low = torch.meshgrid(low, low, indexing="ij")
    y_high, x_high = torch.meshgrid(high, high, indexing="ij")
    box = torch.stack((x_low, y_low, x_high, y_low, x_high, y_high, x_low, y_high), -1).unflatten(-1, (4, 2))

    start, end = corners, corners.roll(-1, 1)
    inward = torch.stack((start[..., 1] - end[..., 1], end[..., 0] - start[..., 0]), -1)
    # Distances inside of each line of a triangle (t, k, k, 4, 3) and of each side of a box (t, k, k, 3, 4).
    to_lines = ((box[..., None, :] - start[:, None, None, None]) * inward[:, None, None, None]).sum(-1)
    a = start[:, None, None].expand(-1, *x_low.shape, -1, -1)
    b = end[:, None, None].expand_as(a)

    def to_sides(point: Tensor) -> Tensor:
        x, y = point.unbind(-1)
        sides = (x - x_low[..., None], x_high[..., None] - x, y - y_low[..., None], y_high[..., None] - y)
        return torch.stack(sides, -1)

    box = box.expand(len(corners), -1, -1, -1, -1)
    pixel_edges = _swept(box, box.roll(-1, -2), to_lines, to_lines.roll(-1, -2))
    return pixel_edges + _swept(a, b, to_sides(a), to_sides(b))


def _swept(a: Tensor, b: Tensor, inside_a: Tensor, inside_b: Tensor) -> Tensor:
    """Sum over n of the solid angles that segments a to b (*, n, 2) sweep where they are inside of m lines.

    Segments are clipped as by Liang and Barsky (1984): they enter through the last line, and leave through the first.
    The triangle of what is left and the tangent point has the solid angle of van Oosterom and Strackee (1983).
    """
    change = inside_b - inside_a
    crossing = -inside_a / torch.where(change == 0, 1.0, change)
    outside = (inside_a < 0) & (inside_b < 0) | (change == 0) & (inside_a < 0)
    enter = torch.where(change > 0, crossing, 0.0).amax(-1).clamp(min=0)
    leave = torch.where(change < 0, crossing, 1.0).amin(-1).clamp(max=1)
    empty = outside.any(-1) | (enter >= leave)
    p, q = (a + (b - a) * share.unsqueeze(-1) for share in (enter, leave))
    p_length, q_length = (1 + p.square().sum(-1)).sqrt(), (1 + q.square().sum(-1)).sqrt()
    volume = p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    angle = 2 * torch.atan2(volume, p_length * q_length + (p * q).sum(-1) + 1 + p_length + q_length)
    return torch.where(empty, 0.0, angle).sum(-1)
