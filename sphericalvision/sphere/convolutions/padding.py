# SPDX-License-Identifier: Apache-2.0
"""Padding of panoramas and cube maps by what the sphere shows there, in place of zeros."""

from __future__ import annotations

from jaxtyping import Shaped
from torch import Tensor, nn

from sphericalvision.core import ArgumentError
from sphericalvision.geometry.bilinear import wrap_panorama
from sphericalvision.shapes import check_shapes
from sphericalvision.sphere.grids.cube_padding import Padding, cube_pad, four_sides


@check_shapes
def equirectangular_pad(
    images: Shaped[Tensor, "*batch H W"], padding: Padding
) -> Shaped[Tensor, "*batch H_out W_out"]:
    """Continue full panoramas across the seam and over the poles.

    Left and right edges meet. Beyond a pole the rows come back on the opposite side, half a turn away; an odd width has
    no column exactly there, so the two at its sides are averaged.

    Args:
        images: ``(*, H, W)``.
        padding: pixels on all sides, or (left, right, top, bottom) as in ``torch.nn.functional.pad``.

    Returns:
        ``(*, top + H + bottom, left + W + right)``.

    Raises:
        ArgumentError: if a padding is negative, or larger than the images.

    Examples:
        >>> import torch
        >>> equirectangular_pad(torch.tensor([[1.0, 2.0, 3.0, 4.0]]), 1)
        tensor([[2., 3., 4., 1., 2., 3.],
                [4., 1., 2., 3., 4., 1.],
                [2., 3., 4., 1., 2., 3.]])
    """
    sides = four_sides(padding)
    height, width = images.shape[-2:]
    if max(sides[:2]) > width or max(sides[2:]) > height:
        raise ArgumentError(
            f"padding: expected at most the size {height} x {width} of the images, got {padding}"
        )
    return wrap_panorama(images, sides)


class _Pad2d(nn.Module):
    """Padding by a width for all sides or one a side."""

    def __init__(self, padding: Padding) -> None:
        super().__init__()
        self.padding = four_sides(padding)

    def extra_repr(self) -> str:
        return str(self.padding)


class EquirectangularPad2d(_Pad2d):
    """Padding of panoramas across the seam and over the poles; see ``equirectangular_pad``.

    Examples:
        >>> import torch
        >>> network = nn.Sequential(EquirectangularPad2d(1), nn.Conv2d(3, 8, 3))
        >>> network(torch.rand(1, 3, 16, 32)).shape
        torch.Size([1, 8, 16, 32])
    """

    def forward(self, images: Shaped[Tensor, "*batch H W"]) -> Shaped[Tensor, "*batch H_out W_out"]:
        return equirectangular_pad(images, self.padding)


class CubePad2d(_Pad2d):
    """Padding of cube maps by the faces across their edges; see ``cube_pad``.

    Examples:
        >>> import torch
        >>> network = nn.Sequential(CubePad2d(1), nn.Conv2d(3, 8, 3))
        >>> network(torch.rand(6, 3, 16, 16)).shape  # one cube map, its faces in the batch
        torch.Size([6, 8, 16, 16])
    """

    def forward(self, faces: Shaped[Tensor, "*batch S S"]) -> Shaped[Tensor, "*batch H_out W_out"]:
        return cube_pad(faces, self.padding)
