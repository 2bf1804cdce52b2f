# SPDX-License-Identifier: Apache-2.0
"""Pixels and weights with which to interpolate across the edges of an image or a panorama."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["taps_across_edges"]


def taps_across_edges(
    pixels: Float[Tensor, "*batch 2"], image_size: tuple[int, int], edges: str = "border", cubic: bool = False
) -> tuple[Int[Tensor, "*batch taps"], Float[Tensor, "*batch taps"]]:
    """Flat ids and weights ``(*, taps)`` that interpolate an image at ``pixels`` ``(*, 2)``, beyond its edges too.

    Args:
        pixels: (u, v), pixel centres at integers; weights are differentiable in them.
        image_size: (height, width).
        edges: ``"border"`` repeats the outermost pixels; ``"around"`` joins the left and the right edge; ``"sphere"``
            joins them, and a row beyond a pole is the pole's row seen from behind, half a turn further.
        cubic: whether for the bicubic kernel (16 taps) or the bilinear one (4); twice as many for ``"sphere"`` and an
            odd width.

    Examples:
        >>> ids, weights = taps_across_edges(torch.tensor([3.25, 0.0]), (1, 4), "around")
        >>> ids[:2], weights[:2]
        (tensor([3, 0]), tensor([0.7500, 0.2500]))
    """
    height, width = image_size
    u, v = pixels[..., :1], pixels[..., 1:]
    offsets = torch.arange(-1, 3, device=pixels.device) if cubic else torch.arange(2, device=pixels.device)
    rows = v.detach().floor().long() + offsets
    row_weights = _kernel(v - rows, cubic)
    columns = u.detach().floor().long() + offsets
    column_weights = _kernel(u - columns, cubic)
    shifts = [torch.zeros_like(rows)]
    if edges == "sphere":
        beyond = (rows < 0) | (rows >= height)
        rows = torch.where(rows < 0, -1 - rows, torch.where(rows >= height, 2 * height - 1 - rows, rows))
        # An odd width has no pixel exactly behind, hence the mean of its two.
        shifts = [torch.where(beyond, turn, 0) for turn in sorted({width // 2, (width + 1) // 2})]
    starts = rows.clamp(0, height - 1).unsqueeze(-1) * width
    weights = (row_weights.unsqueeze(-1) * column_weights.unsqueeze(-2)).flatten(-2) / len(shifts)
    ids = []
    for shift in shifts:
        column = columns.unsqueeze(-2) + shift.unsqueeze(-1)
        column = column.clamp(0, width - 1) if edges == "border" else column.remainder(width)
        ids.append((starts + column).flatten(-2))
    return torch.cat(ids, -1), torch.cat([weights] * len(shifts), -1)


def _kernel(distance: Tensor, cubic: bool) -> Tensor:
    """Weights of the linear kernel, or of Keys' cubic with the slope -0.75 that torch and OpenCV use."""
    x = distance.abs()
    if not cubic:
        return 1 - x
    near = (1.25 * x - 2.25) * x * x + 1
    far = ((-0.75 * x + 3.75) * x - 6) * x + 3
    return torch.where(x <= 1, near, far)
