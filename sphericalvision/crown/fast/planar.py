# SPDX-License-Identifier: Apache-2.0
"""Planar convolutions of rectangles that are continued by their own border values, in little memory."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sphericalvision.crown.fast.double_backward import reference_gradients

__all__ = ["conv2d_replicate"]


def conv2d_replicate(
    images: Float[Tensor, "B C h w"],
    kernel: Float[Tensor, "O C 3 3"],
    bias: Float[Tensor, " O"] | None = None,
) -> Float[Tensor, "B O h w"]:
    """Convolve images ``(B, C, h, w)`` with ``(O, C, 3, 3)``, continued by their own border values.

    For the backward pass the images are kept as they are given, not a second time with their borders.

    Args:
        images: ``(B, C, h, w)``.
        kernel: ``(O, C, 3, 3)``.
        bias: ``(O,)``.

    Examples:
        >>> conv2d_replicate(torch.ones(1, 2, 5, 3), torch.ones(1, 2, 3, 3)).unique()
        tensor([18.])
    """
    result: Tensor = _Planar.apply(images, kernel, bias)
    return result


def _convolve(images: Tensor, kernel: Tensor, bias: Tensor | None) -> Tensor:
    return F.conv2d(F.pad(images, (1, 1, 1, 1), mode="replicate"), kernel, bias)


class _Planar(torch.autograd.Function):
    """Images, kernel and bias to convolved images."""

    @staticmethod
    def forward(images: Tensor, kernel: Tensor, bias: Tensor | None) -> Tensor:
        return _convolve(images, kernel, bias)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        images, kernel, bias = ctx.saved_tensors
        wanted = ctx.needs_input_grad
        if torch.is_grad_enabled():
            return tuple(reference_gradients(_convolve, (images, kernel, bias), wanted, gradient))
        grad_padded, grad_kernel, _ = torch.ops.aten.convolution_backward(
            gradient,
            F.pad(images, (1, 1, 1, 1), mode="replicate"),
            kernel,
            None,
            (1, 1),
            (0, 0),
            (1, 1),
            False,
            (0, 0),
            1,
            (wanted[0], wanted[1], False),
        )
        grad_images = _folded(grad_padded) if wanted[0] else None
        return grad_images, grad_kernel, gradient.sum((0, 2, 3)) if wanted[2] else None


def _folded(padded: Tensor) -> Tensor:
    """The adjoint of continuing images by their border values: what was repeated is added to where it came from."""
    padded[..., 1, :] += padded[..., 0, :]
    padded[..., -2, :] += padded[..., -1, :]
    padded[..., 1] += padded[..., 0]
    padded[..., -2] += padded[..., -1]
    return padded[..., 1:-1, 1:-1]
