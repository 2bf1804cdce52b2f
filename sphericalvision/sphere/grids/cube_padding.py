# SPDX-License-Identifier: Apache-2.0
"""Faces of cube maps continued across their edges."""

from __future__ import annotations

import torch
from jaxtyping import Shaped
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError, check_tensor
from sphericalvision.geometry.lookup import read_entries
from sphericalvision.sphere.grids.cube_layouts import world_from_cube_face

Padding = int | tuple[int, int, int, int]


def cube_pad(faces: Shaped[Tensor, "*batch S S"], padding: Padding) -> Shaped[Tensor, "*batch H_out W_out"]:
    """Continue each face of cube maps by the rows and columns of the faces across its edges.

    Row k beyond an edge is row k of the neighbour on its side of the edge: the cube is unfolded there. In the corners,
    where three faces meet and no pixel is, stands the mean of the two nearest padded pixels, one of each edge.

    Args:
        faces: ``(B, C, 6, S, S)`` in the order of ``Cubemap`` (front, right, back, left, up, down), or
            ``(6 * B, C, S, S)``, the six faces of one map after the other in the batch, as planar layers want them.
        padding: pixels on all sides, or (left, right, top, bottom) as in ``torch.nn.functional.pad``.

    Returns:
        Faces of the same layout, larger by the padding.

    Raises:
        ShapeError: if the faces are not so.
        ArgumentError: if a padding is negative, or larger than the faces.

    References:
        Cheng et al. (2018), "Cube padding for weakly-supervised saliency prediction in 360° videos".

    Examples:
        >>> number = torch.arange(6.0).view(1, 1, 6, 1, 1).expand(1, 1, 6, 2, 2)
        >>> cube_pad(number, 1)[0, 0, 0]  # around the front face: up, right, down, left
        tensor([[3.5000, 4.0000, 4.0000, 2.5000],
                [3.0000, 0.0000, 0.0000, 1.0000],
                [3.0000, 0.0000, 0.0000, 1.0000],
                [4.0000, 5.0000, 5.0000, 3.0000]])
    """
    check_tensor("faces", faces, "(B, C, 6, S, S)")
    if faces.ndim == 4 and faces.shape[0] % 6 == 0:
        stacked = faces.unflatten(0, (-1, 6)).transpose(1, 2)
        return cube_pad(stacked, padding).transpose(1, 2).flatten(0, 1)
    if faces.ndim < 5 or faces.shape[-3] != 6 or faces.shape[-1] != faces.shape[-2]:
        raise ShapeError(
            f"faces: expected shape (B, C, 6, S, S) or (6 * B, C, S, S), got {tuple(faces.shape)}"
        )
    size, sides = faces.shape[-1], four_sides(padding)
    if max(sides) > size:
        raise ArgumentError(f"padding: expected at most the size {size} of the faces, got {padding}")
    return faces_continued(faces, sides)


def faces_continued(
    faces: Shaped[Tensor, "*batch 6 S S"], sides: tuple[int, int, int, int]
) -> Shaped[Tensor, "*batch 6 H_out W_out"]:
    """``cube_pad`` of cube maps ``(*, 6, S, S)`` by (left, right, top, bottom).

    Examples:
        >>> faces_continued(torch.ones(6, 2, 2), (1, 0, 0, 0)).shape
        torch.Size([6, 2, 3])
    """
    size = faces.shape[-1]
    # Only the border is looked up: the faces themselves are copied, which is much faster.
    borders = _border(size, sides, faces.device)
    row, column = (torch.cat([places.flatten() for places in pair]) for pair in zip(*borders, strict=True))
    ids = torch.stack(cube_border_ids(row, column, size))
    values = read_entries(faces.flatten(-3), ids).mean(-3)
    strips = values.split([places.numel() for places, _ in borders], -1)
    above, west, east, below = (
        strip.unflatten(-1, tuple(places.shape)) for strip, (places, _) in zip(strips, borders, strict=True)
    )
    return torch.cat((above, torch.cat((west, faces, east), -1), below), -2)


def _border(size: int, sides: tuple[int, int, int, int], device: torch.device) -> list[tuple[Tensor, Tensor]]:
    """Return (row, column) of the places above, west, east and below of a face, each ``(height, width)``."""
    left, right, top, bottom = sides

    def places(rows: tuple[int, int], columns: tuple[int, int]) -> tuple[Tensor, Tensor]:
        row, column = torch.arange(*rows, device=device), torch.arange(*columns, device=device)
        return row[:, None].expand(-1, len(column)), column.expand(len(row), -1)

    across = (-left, size + right)
    return [
        places((-top, 0), across),
        places((0, size), (-left, 0)),
        places((0, size), (size, size + right)),
        places((size, size + bottom), across),
    ]


def cube_border_ids(row: Tensor, column: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Return two pixels ``(6, m)`` whose mean is seen at places ``(m,)`` around each of the faces.

    They are the same pixel everywhere but in the corners.

    Examples:
        >>> row, column = torch.tensor([0, 0]), torch.tensor([-1, 1])  # left and right of faces of one pixel
        >>> cube_border_ids(row, column, 1)[0][0]
        tensor([3, 1])
    """
    # Pixel centres are odd numbers from 1 - size to size - 1, the surface of the cube is at size.
    row, column = 2 * row + 1 - size, 2 * column + 1 - size
    corner = (row.abs() > size) & (column.abs() > size)
    sideways = _fold(torch.where(corner, row.clamp(1 - size, size - 1), row), column, size)
    below = _fold(row, torch.where(corner, column.clamp(1 - size, size - 1), column), size)
    return sideways, below


def _fold(row: Tensor, column: Tensor, size: int) -> Tensor:
    """Return the pixel ``(6, m)`` that lies at a place in the plane of each face once that plane is folded."""
    world_from_face = world_from_cube_face(torch.long, row.device)
    forward = size - (row.abs() - size).clamp(min=0) - (column.abs() - size).clamp(min=0)
    local = torch.stack((column.clamp(-size, size), row.clamp(-size, size), forward), -1)
    world = (world_from_face[:, None] * local[:, None, :]).sum(-1)
    coords = (world[..., None, :, None] * world_from_face).sum(-2)  # in the frame of each of six faces
    face = coords[..., 2].argmax(-1)
    column, row, _ = coords.gather(-2, face[..., None, None].expand(*face.shape, 1, 3)).squeeze(-2).unbind(-1)
    return (face * size + (row + size - 1) // 2) * size + (column + size - 1) // 2


def four_sides(padding: Padding) -> tuple[int, int, int, int]:
    """Return (left, right, top, bottom) of a padding, or raise ``ArgumentError``.

    Examples:
        >>> four_sides(2)
        (2, 2, 2, 2)
    """
    sides = (padding,) * 4 if isinstance(padding, int) else tuple(padding)
    if len(sides) != 4 or min(sides) < 0:
        raise ArgumentError(
            f"padding: expected pixels on all sides or (left, right, top, bottom), not negative, got {padding}"
        )
    return sides[0], sides[1], sides[2], sides[3]
