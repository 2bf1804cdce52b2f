# SPDX-License-Identifier: Apache-2.0
"""Where the kernels of ``sphere_conv2d`` read, in pixels."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.core import ArgumentError

__all__ = ["sphere_taps"]


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
    up = (torch.arange(rows, dtype=torch.float64, device=device) - rows // 2) * (
        dilation[0] * math.pi / height
    )
    right = (torch.arange(columns, dtype=torch.float64, device=device) - columns // 2) * (
        dilation[1] * 2 * math.pi / width
    )
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
