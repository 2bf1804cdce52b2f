# SPDX-License-Identifier: Apache-2.0
"""The crown: values on an icosphere laid out as ten rectangles, five each way, so that planar convolutions apply.

``col`` rectangle k is chart k of the icosphere with all its borders. ``row`` rectangle k lies across: its
western half is the northern half of chart k, its eastern half the southern half of chart k + 1. Vertices on
the border of one kind of rectangle are inside the other, which is why both are kept and averaged now and
then (``exchange``).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float, Num
from torch import Tensor

from sphericalvision.core import ArgumentTypeError, ShapeError, check_floating
from sphericalvision.crown.fast import fold, unfold
from sphericalvision.crown.places import level_of_rectangles
from sphericalvision.shapes import check_shapes


class Crown(NamedTuple):
    """Five rectangles each way; ``n = 2**level``, and volumes have N hypotheses.

    Attributes:
        col: ``(B, 5, C, 2n + 1, n + 1)`` or ``(B, 5, C, N, 2n + 1, n + 1)``.
        row: ``(B, 5, C, n + 1, 2n + 1)`` or ``(B, 5, C, N, n + 1, 2n + 1)``.

    ``crown + other`` adds the rectangles.

    Examples:
        >>> crown = to_crown(torch.zeros(1, 8, 162))
        >>> crown.col.shape, crown.row.shape
        (torch.Size([1, 5, 8, 9, 5]), torch.Size([1, 5, 8, 5, 9]))
        >>> crown.level
        2
    """

    col: Num[Tensor, "B 5 C *N long short"]
    row: Num[Tensor, "B 5 C *N short long"]

    @property
    def level(self) -> int:
        """Level of the icosphere whose vertices are laid out."""
        return level_of_rectangles(self.col)

    def __add__(self, other: Crown) -> Crown:  # type: ignore[override]
        check_crown(other)
        if other.col.shape != self.col.shape:
            raise ShapeError(
                f"crown: expected the shapes of the other summand, col {tuple(self.col.shape)}, "
                f"got {tuple(other.col.shape)}"
            )
        return Crown(self.col + other.col, self.row + other.row)


def check_crown(crown: Crown, spatial_dims: int | None = None, channels: int | None = None) -> None:
    """Raise ``ShapeError`` unless ten rectangles match, of ``spatial_dims`` 2 or 3 and so many channels if given."""
    if not (isinstance(crown, tuple) and len(crown) == 2):
        got = f"a tensor of shape {tuple(crown.shape)}" if isinstance(crown, Tensor) else type(crown).__name__
        raise ArgumentTypeError(
            f"crown: expected a Crown of rectangles, col and row, got {got}; make it with to_crown"
        )
    col, row = crown
    n = col.shape[-1] - 1 if col.ndim >= 5 else 0
    sizes_match = n > 0 and n & (n - 1) == 0 and tuple(col.shape[-2:]) == (2 * n + 1, n + 1)
    matches = sizes_match and col.ndim in (5, 6) and (*col.shape[:-2], n + 1, 2 * n + 1) == tuple(row.shape)
    if not matches or col.shape[1] != 5 or (spatial_dims is not None and col.ndim != spatial_dims + 3):
        hypotheses = {None: "[N,] ", 2: "", 3: "N, "}[spatial_dims]
        raise ShapeError(
            f"crown: expected col (B, 5, C, {hypotheses}2n + 1, n + 1) and "
            f"row (B, 5, C, {hypotheses}n + 1, 2n + 1) with n = 2**level, "
            f"got col {tuple(col.shape)} and row {tuple(row.shape)}; make it with to_crown"
        )
    if channels is not None and col.shape[2] != channels:
        raise ShapeError(f"crown: expected {channels} channels (dimension 2), got {col.shape[2]}")


@check_shapes
def to_crown(values: Num[Tensor, "B C V"] | Num[Tensor, "B C N V"]) -> Crown:
    """Lay values on an icosphere out as a crown; its level follows from the number of vertices.

    Args:
        values: ``(B, C, V)``, or ``(B, C, N, V)`` with N hypotheses.

    Raises:
        ShapeError: if the shape is another one or V is not the number of vertices of an icosphere.

    References:
        Komatsu et al. (2020), "360° depth estimation from multiple fisheye images with origami crown
        representation of icosahedron", section III.

    Examples:
        >>> to_crown(torch.arange(12.0).view(1, 1, 12)).col[0, 0, 0]
        tensor([[ 0.,  3.],
                [ 1.,  4.],
                [ 2., 11.]])
    """
    return Crown(*unfold(values))


def from_crown(crown: Crown) -> Float[Tensor, "B C *N V"]:
    """Return values on the icosphere, ``(B, C, V)`` or ``(B, C, N, V)``: the mean over all copies of a vertex.

    Raises:
        ShapeError: if the rectangles do not belong together.
        ArgumentError: if they hold integers.

    References:
        Komatsu et al. (2020), the inverse of the unfolding to the crown.

    Examples:
        >>> values = torch.rand(2, 3, 42)
        >>> torch.allclose(from_crown(to_crown(values)), values)
        True
    """
    check_crown(crown)
    check_floating("crown", crown.col)
    return fold(*crown)


def exchange(crown: Crown) -> Crown:
    """Give every place of a vertex the mean over all its places, so that values flow across borders.

    Examples:
        >>> crown = exchange(Crown(torch.ones(1, 5, 1, 3, 2), torch.zeros(1, 5, 1, 2, 3)))
        >>> crown.col.unique()
        tensor([0.5000])
    """
    return to_crown(from_crown(crown))


def crown_map(function: Callable[..., Tensor], *crowns: Crown) -> Crown:
    """Apply a function to the ``col`` tensors and to the ``row`` tensors of one or more crowns.

    Examples:
        >>> crown = to_crown(torch.ones(1, 1, 12))
        >>> crown_map(torch.add, crown, crown).col.unique()
        tensor([2.])
    """
    for crown in crowns:
        check_crown(crown)
    return Crown(function(*(crown.col for crown in crowns)), function(*(crown.row for crown in crowns)))


def crown_relu(crown: Crown) -> Crown:
    """Rectify a crown.

    Examples:
        >>> crown_relu(to_crown(-torch.ones(1, 1, 12))).row.max()
        tensor(0.)
    """
    return crown_map(torch.relu, crown)
