# SPDX-License-Identifier: Apache-2.0
"""Convolutions whose kernels read the same places in all columns of a row, quickly on a CPU.

On a panorama a kernel is moved along its row without a change, so what one tap reads in a row of centres is a weighted
sum of a few rows of pixels, each rolled by a whole number of columns. A table of these sums is as long as the image is
high, and its adjoint is a table of the same form: gradients gather, too, where other ways scatter. A few rows of
centres at a time stay in cache, and nothing that is larger than the images is kept.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

CACHE_BYTES = 3 << 20
"""About what is made of the rows that are convolved together."""


class RowSums(NamedTuple):
    """For each of q rows made, the m rows that it is a sum of; rows that need fewer repeat one with weight zero.

    Attributes:
        row: ``(q, m)``, row of the source.
        shift: ``(q, m)``, column of the source that column 0 reads; others follow, around the image.
        weight: ``(q, m)``, float64.
        needed: ``(q,)``, how many of the m are.
    """

    row: Tensor
    shift: Tensor
    weight: Tensor
    needed: Tensor


def row_sums(
    target: Int[Tensor, " e"],
    row: Int[Tensor, " e"],
    shift: Int[Tensor, " e"],
    weight: Float[Tensor, " e"],
    num_targets: int,
) -> RowSums:
    """Sort entries ``(e,)`` by the row that they belong to.

    Examples:
        >>> sums = row_sums(*torch.tensor([[1, 0, 1], [5, 6, 7], [0, 0, 2]]), torch.tensor([0.5, 1.0, 0.5]), 2)
        >>> sums.row, sums.needed
        (tensor([[6, 6],
                [5, 7]]), tensor([1, 2]))
    """
    order = target.argsort(stable=True)
    target = target[order]
    count = torch.bincount(target, minlength=num_targets)
    first = count.cumsum(0) - count
    rank = torch.arange(len(target), device=target.device) - first[target]
    unused = torch.arange(int(count.max()), device=target.device) >= count[:, None]

    def arranged(entries: Tensor) -> Tensor:
        table = entries.new_zeros(unused.shape)
        table[target, rank] = entries[order]
        return table

    row, shift = (torch.where(unused, table[:, :1], table) for table in (arranged(row), arranged(shift)))
    return RowSums(row, shift, arranged(weight), count)


def adjoint(sums: RowSums, num_rows: int, num_taps: int, length: int) -> RowSums:
    """The sums that gradients of the source are made of, one row for each row of the source and tap."""
    device = sums.row.device
    sources = torch.arange(len(sums.row), device=device)[:, None].expand_as(sums.row)
    used = torch.arange(sums.row.shape[1], device=device) < sums.needed[:, None]
    sources, row, shift, weight = sources[used], sums.row[used], sums.shift[used], sums.weight[used]
    slots = row * num_taps + sources % num_taps
    return row_sums(slots, sources // num_taps, -shift % length, weight, num_rows * num_taps)


def conv_of_row_sums(
    rows: Float[Tensor, " ..."],
    weight: Float[Tensor, " ..."],
    forward: RowSums,
    backward: RowSums,
    groups: int,
) -> Float[Tensor, " ..."]:
    """Convolve rows of pixels, differentiable twice.

    Args:
        rows: ``(B, in, R, N)``, periodic along N.
        weight: ``(out, in / groups, K)``.
        forward: K sums for each of Q rows of centres, in this order.
        backward: ``adjoint`` of these.
        groups: of channels that are convolved apart.

    Returns:
        ``(B, out, Q, N)``.
    """
    result: Tensor = _Convolution.apply(rows, weight, forward, backward, groups)
    return result


class _Convolution(torch.autograd.Function):
    """Rows and weight to convolved rows."""

    @staticmethod
    def forward(rows: Tensor, weight: Tensor, forward: RowSums, backward: RowSums, groups: int) -> Tensor:
        kernel = weight.unsqueeze(-1)
        num_taps = weight.shape[-1]
        outputs = [
            torch.cat([F.conv2d(read, kernel, None, (num_taps, 1), groups=groups) for _, read in parts], 2)
            for parts in (_read(sample, forward, num_taps) for sample in rows)
        ]
        return torch.cat(outputs)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        rows, weight, ctx.sums, ctx.adjoint, ctx.groups = inputs
        ctx.save_for_backward(rows, weight)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        rows, weight = ctx.saved_tensors
        want_rows, want_weight = ctx.needs_input_grad[:2]
        groups, num_taps = ctx.groups, weight.shape[-1]
        if torch.is_grad_enabled():  # to be differentiated again: the same from operations of torch
            inputs = [tensor for tensor in (rows, weight) if tensor.requires_grad]
            results = torch.autograd.grad(
                _gathered(rows, weight, ctx.sums, groups), inputs, gradient, create_graph=True
            )
            gradients = iter(results)
            return (*(next(gradients) if t.requires_grad else None for t in (rows, weight)), None, None, None)
        # In and out change places: (in, out / groups, K, 1).
        turned = weight.unflatten(0, (groups, -1)).transpose(1, 2).flatten(0, 1).unsqueeze(-1).contiguous()
        grad_weight = torch.zeros_like(turned)
        grad_rows = []
        for sample, grad_sample in zip(rows, gradient, strict=True):
            chunks = []
            for place, read in _read(grad_sample, ctx.adjoint, num_taps):
                if want_rows:
                    chunks.append(F.conv2d(read, turned, None, (num_taps, 1), groups=groups))
                if want_weight:
                    grad_weight += torch.ops.aten.convolution_backward(
                        sample[None, :, place].contiguous(memory_format=torch.channels_last),
                        read,
                        turned,
                        None,
                        (num_taps, 1),
                        (0, 0),
                        (1, 1),
                        False,
                        (0, 0),
                        groups,
                        (False, True, False),
                    )[1]
            grad_rows += [torch.cat(chunks, 2)] if want_rows else []
        grad_weight = grad_weight.squeeze(-1).unflatten(0, (groups, -1)).transpose(1, 2).flatten(0, 1)
        return (
            torch.cat(grad_rows) if want_rows else None,
            grad_weight if want_weight else None,
            None,
            None,
            None,
        )


def _read(rows: Tensor, sums: RowSums, num_taps: int) -> Any:
    """Yield places (a slice of Q) and what their taps read, ``(1, C, len * K, N)`` with channels innermost."""
    channels, _, length = rows.shape
    pixels = rows.permute(1, 2, 0)
    # Twice around, so that a row rolled by any number of columns is in one piece.
    pixels = torch.cat((pixels, pixels), 1).reshape(-1, channels)
    columns = torch.arange(length, dtype=torch.int32, device=rows.device)
    together = max(1, CACHE_BYTES // (num_taps * length * channels * rows.element_size()))
    for start in range(0, len(sums.row) // num_taps, together):
        chunk = slice(start, min(start + together, len(sums.row) // num_taps))
        taps = slice(chunk.start * num_taps, chunk.stop * num_taps)
        most = int(sums.needed[taps].max().clamp(min=1))
        first = (sums.row[taps, :most] * (2 * length) + sums.shift[taps, :most]).to(columns)
        ids = first[:, None] + columns[:, None]
        weights = sums.weight[taps, None, :most].to(pixels).expand(ids.shape)
        read = F.embedding_bag(
            ids.flatten(0, 1), pixels, mode="sum", per_sample_weights=weights.reshape(-1, most)
        )
        yield chunk, read.view(1, -1, length, channels).permute(0, 3, 1, 2)


def _gathered(rows: Tensor, weight: Tensor, sums: RowSums, groups: int) -> Tensor:
    """The same by gathering pixel by pixel, which has derivatives of any order."""
    num_taps, length = weight.shape[-1], rows.shape[-1]
    columns = torch.arange(length, device=rows.device)
    read = rows.new_zeros(())
    for row, shift, share in zip(sums.row.T, sums.shift.T, sums.weight.T, strict=True):
        ids = row[:, None] * length + (shift[:, None] + columns) % length
        pixels = rows.flatten(2).index_select(2, ids.flatten()).unflatten(2, tuple(ids.shape))
        read = read + pixels * share[:, None].to(rows)
    return F.conv2d(read, weight.unsqueeze(-1), None, (num_taps, 1), groups=groups)
