# SPDX-License-Identifier: Apache-2.0
"""Convolution of equirectangular images whose kernel lies in the tangent plane of each pixel."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.core import ArgumentError, ShapeError, check_counts, check_dtype
from sphericalvision.kernels import Operator
from sphericalvision.shapes import check_shapes
from sphericalvision.sphere.fast.door import conv_in_rows, read_pixels


@check_shapes
def sphere_conv2d(
    images: Float[Tensor, "B C_in H W"],
    weight: Float[Tensor, "C_out C_group h w"],
    bias: Float[Tensor, " C_out"] | None = None,
    stride: int | tuple[int, int] = 1,
    dilation: int | tuple[int, int] = 1,
    groups: int = 1,
) -> Float[Tensor, "B C_out H_out W_out"]:
    """Convolve equirectangular images with kernels in the tangent plane, across the seam and over the poles.

    Args:
        images: ``(B, in, H, W)``, full panoramas.
        weight: ``(out, in / groups, kernel height, kernel width)``, as that of a planar convolution.
        bias: ``(out,)``.
        stride: centres are the pixels 0, stride, 2 * stride and so on, as in a planar convolution.
        dilation: steps of taps, in pixels at the equator.
        groups: of channels that are convolved apart.

    Returns:
        ``(B, out, ceil(H / stride), ceil(W / stride))``.

    References:
        Coors, Condurache and Geiger (2018), "SphereNet".

    Examples:
        >>> sphere_conv2d(torch.ones(1, 3, 16, 32), torch.ones(8, 3, 3, 3), stride=2).shape
        torch.Size([1, 8, 8, 16])
    """
    check_dtype("images", images, weight)
    if images.shape[1] != weight.shape[1] * groups:
        raise ShapeError(
            f"images and weight: expected shapes (B, in, H, W) and (out, in / {groups}, h, w), "
            f"got {tuple(images.shape)} and {tuple(weight.shape)}"
        )
    stride, dilation = along_both(stride), along_both(dilation)
    return _convolve(images, weight, bias, stride, dilation, groups, sphere_taps)


def _convolve_taps(
    images: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    stride: tuple[int, int],
    dilation: tuple[int, int],
    groups: int,
    taps_of: Callable[..., Tensor],
) -> Tensor:
    height, width = images.shape[-2:]
    rows, columns = weight.shape[-2:]
    taps = taps_of((height, width), (rows, columns), stride, dilation, images.dtype, images.device)
    shift = torch.arange(0, width, stride[1], dtype=taps.dtype, device=taps.device)
    # One tap of one kernel next to the other, as in an image, for a planar convolution that steps by the kernel.
    u = taps[..., 0].flatten(0, 1)[:, None] + shift[:, None]
    v = taps[..., 1].flatten(0, 1)[:, None].expand_as(u)
    pixels = torch.stack((u, v), -1).view(-1, 2)
    picture = read_pixels(images, pixels).view(*images.shape[:2], len(taps) * rows, len(shift) * columns)
    return F.conv2d(picture, weight, bias, (rows, columns), groups=groups)


_convolve = Operator(_convolve_taps, cpu=conv_in_rows)


class SphereConv2d(nn.Conv2d):
    """Convolution of equirectangular images ``(B, C, H, W)`` in tangent planes; see ``sphere_conv2d``.

    It is an ``nn.Conv2d`` in its weights: either loads the ``state_dict`` of the other. Padding is not asked for, as
    a sphere has no border.

    Args:
        in_channels: channels of the images given.
        out_channels: channels of the images returned.
        kernel_size: odd.
        stride: centres are the pixels 0, stride, 2 * stride and so on.
        dilation: steps of taps, in pixels at the equator.
        groups: of channels that are convolved apart.
        bias: whether to add a learned bias.

    Examples:
        >>> layer = SphereConv2d(3, 8)
        >>> layer.load_state_dict(nn.Conv2d(3, 8, 3).state_dict())
        <All keys matched successfully>
        >>> layer
        SphereConv2d(3, 8, kernel_size=(3, 3), stride=(1, 1))
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: int | tuple[int, int] = 3,
        stride: int | tuple[int, int] = 1,
        dilation: int | tuple[int, int] = 1,
        groups: int = 1,
        bias: bool = True,
    ) -> None:
        check_counts(in_channels=in_channels, out_channels=out_channels)
        if any(size % 2 == 0 for size in along_both(kernel_size)):
            raise ArgumentError(f"kernel_size: expected odd sizes, which have a centre, got {kernel_size}")
        super().__init__(
            in_channels, out_channels, kernel_size, stride, dilation=dilation, groups=groups, bias=bias
        )

    def forward(self, input: Float[Tensor, "B C_in H W"]) -> Float[Tensor, "B C_out H_out W_out"]:
        return sphere_conv2d(
            input, self.weight, self.bias, along_both(self.stride), along_both(self.dilation), self.groups
        )


def along_both(size: int | tuple[int, ...]) -> tuple[int, int]:
    """A size of one number or of two as two: along rows and along columns."""
    return (size, size) if isinstance(size, int) else (size[0], size[1])


def sphere_taps(
    image_size: tuple[int, int],
    kernel_size: tuple[int, int] = (3, 3),
    stride: tuple[int, int] = (1, 1),
    dilation: tuple[int, int] = (1, 1),
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> Float[Tensor, "rows h w 2"]:
    """Return the pixels (u, v) that the kernels in column 0 read, ``(rows, kernel height, kernel width, 2)``.

    The kernel of column j reads the same pixels j columns further on. With pixel steps Δλ = 2π / W and Δφ = π / H, tap
    (a, b) off the centre stands at (tan bΔλ, tan aΔφ / cos bΔλ) in the tangent plane, so that at the equator taps are
    the centres of pixels. Over a pole a kernel reads the other side; v stays within half a pixel of the image.

    Args:
        image_size: (height, width) of a full panorama.
        kernel_size: (height, width), odd.
        stride: (vertical, horizontal): centres are the pixels 0, stride, 2 * stride and so on.
        dilation: (vertical, horizontal) steps of taps, in pixels.
        dtype: of the pixels, computed in float64; the default dtype of torch when not given.
        device: of the pixels.

    Raises:
        ArgumentError: if a size is no positive integer, the kernel's is even, or it reaches 90° from its centre.

    References:
        Coors, Condurache and Geiger (2018), "SphereNet: learning spherical representations for detection and
        classification in omnidirectional images", equations 1 to 4.

    Examples:
        >>> sphere_taps((5, 10))[2, 1]  # in the equator's row: the pixel before, the centre, the pixel after
        tensor([[-1.,  2.],
                [ 0.,  2.],
                [ 1.,  2.]])
    """
    (height, width), (rows, columns) = image_size, kernel_size
    for name, pair in (("image_size", image_size), ("stride", stride), ("dilation", dilation)):
        if min(pair) < 1:
            raise ArgumentError(f"{name}: expected positive integers, got {pair}")
    if rows % 2 == 0 or columns % 2 == 0 or min(kernel_size) < 1:
        raise ArgumentError(f"kernel_size: expected odd sizes, which have a centre, got {kernel_size}")
    a, b = (torch.arange(size, dtype=torch.float64, device=device) - size // 2 for size in kernel_size)
    up, right = a * (dilation[0] * math.pi / height), b * (dilation[1] * 2 * math.pi / width)
    if (rows // 2) * dilation[0] * 2 >= height or (columns // 2) * dilation[1] * 4 >= width:
        raise ArgumentError(
            f"kernel_size: {kernel_size} with dilation {dilation} reaches 90° from its centre in an image of "
            f"{height} x {width} pixels; use a larger image or a smaller kernel"
        )
    row = torch.arange(0, height, stride[0], dtype=torch.float64, device=device)
    latitude = ((height - 1 - 2 * row) * (math.pi / 2 / height))[:, None, None]
    x, y = right.tan(), up[:, None].tan() / right.cos()
    # The tangent point looks forward: up is cos(latitude) of the axis and -sin(latitude) of the view.
    forward = latitude.cos() + y * latitude.sin()
    height_above = latitude.sin() - y * latitude.cos()
    longitude = torch.atan2(x, forward)
    tap_latitude = torch.atan2(height_above, (x * x + forward * forward).sqrt())
    u = longitude * (width / (2 * math.pi))
    v = (height - 1) / 2 - tap_latitude * (height / math.pi)
    return torch.stack((u, v), -1).to(dtype or torch.get_default_dtype())
