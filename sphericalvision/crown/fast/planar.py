# SPDX-License-Identifier: Apache-2.0
"""Planar convolutions of rectangles that are continued by their own border values, in little memory."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

__all__ = ["conv2d_replicate"]


def conv2d_replicate(images: Tensor, kernel: Tensor, bias: Tensor | None = None, stride: int = 1) -> Tensor:
    """Convolve images ``(B, C, h, w)`` with ``(O, C, 3, 3)``, continued by their own border values.

    Args:
        images: ``(B, C, h, w)``.
        kernel: ``(O, C, 3, 3)``.
        bias: ``(O,)``.
        stride: 1 or 2.

    Examples:
        >>> conv2d_replicate(torch.ones(1, 2, 5, 3), torch.ones(1, 2, 3, 3)).unique()
        tensor([18.])
    """
    if torch.compiler.is_compiling():
        return F.conv2d(_cat_border(images), kernel, bias, stride)
    wanted = torch.is_grad_enabled() and (images.requires_grad or kernel.requires_grad)
    plain = stride > 1 or images.device.type != "cpu" or torch.is_autocast_enabled("cpu")
    if plain or not wanted:
        return F.conv2d(F.pad(images, (1, 1, 1, 1), mode="replicate"), kernel, bias, stride)
    result: Tensor = _Planar.apply(images, kernel, bias)
    return result


class _Planar(torch.autograd.Function):
    """Images, kernel and bias to convolved images; only the images are kept, without their borders."""

    @staticmethod
    def forward(images: Tensor, kernel: Tensor, bias: Tensor | None) -> Tensor:
        return F.conv2d(F.pad(images, (1, 1, 1, 1), mode="replicate"), kernel, bias)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:2])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        images, kernel = ctx.saved_tensors
        wanted = ctx.needs_input_grad
        of_padded, of_kernel, _ = torch.ops.aten.convolution_backward(
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
        of_images = _folded(of_padded) if wanted[0] else None
        return of_images, of_kernel, gradient.sum((0, 2, 3)) if wanted[2] else None


def _folded(padded: Tensor) -> Tensor:
    """The adjoint of continuing images by their border values."""
    padded[..., 1, :] += padded[..., 0, :]
    padded[..., -2, :] += padded[..., -1, :]
    padded[..., 1] += padded[..., 0]
    padded[..., -2] += padded[..., -1]
    return padded[..., 1:-1, 1:-1]


def _cat_border(images: Tensor) -> Tensor:
    """Padding for compiled graphs: inductor expects another memory format of a padding's gradient than it gets."""
    tall = torch.cat((images[..., :1, :], images, images[..., -1:, :]), -2)
    return torch.cat((tall[..., :1], tall, tall[..., -1:]), -1)
