# SPDX-License-Identifier: Apache-2.0
"""Lookups by index: each of P results is a weighted sum of few entries of a flat source.

``weighted_rows`` serves sweeps, which read the vertices of triangles. ``Lookup`` is a module for vertices, pixels of
HEALPix, or one pixel for a label: it maps values ``(*b, C, ...)`` to ``(*b, C, P)``, gives zero where nothing is seen,
and is differentiable in values and weights. Its tables move with ``.to`` and are not saved. ``image_lookup`` is the
same for positions in images.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Self

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn

from sphericalvision.geometry.directions import HALF, broadcast_shapes
from sphericalvision.kernels import prefer_fused, uses_reference_kernels


def read_entries(
    values: Shaped[Tensor, "*batch size"], ids: Int[Tensor, "*entries"]
) -> Shaped[Tensor, " ..."]:
    """Entries ``(*b, *entries)`` of the last dimension of values, by number.

    Examples:
        >>> read_entries(torch.tensor([[1.0, 3.0, 5.0]]), torch.tensor([[2, 0], [1, 1]]))
        tensor([[[5., 1.],
                 [3., 3.]]])
    """
    flat = ids.flatten()
    if prefer_fused(values.device):
        result = values.index_select(-1, flat)
    else:  # on a CPU in an eighth of the time
        result = values.gather(-1, flat.expand(*values.shape[:-1], -1))
    return result.unflatten(-1, tuple(ids.shape))


def weighted_rows(
    rows: Float[Tensor, "size C"], ids: Int[Tensor, "P k"], weights: Float[Tensor, "P k"]
) -> Float[Tensor, "P C"]:
    """Weighted sums ``(P, C)`` of k rows ``(size, C)`` each.

    A row is read at once, so large tables keep the channels of an entry side by side. The kernel has first derivatives.
    Under ``reference_kernels`` the sum is written out and has derivatives of any order; and for compilers, which make
    one loop of it.

    Args:
        rows: floating point.
        ids: of the rows, k for each of P sums.
        weights: of the ids' shape.

    Examples:
        >>> weighted_rows(torch.tensor([[1.0, 2.0], [5.0, 6.0]]), torch.tensor([[0, 1]]), torch.tensor([[0.5, 0.5]]))
        tensor([[3., 4.]])
    """
    weights = weights.to(rows.dtype)
    # The kernel has a warp of a CUDA device read a row, which few channels leave idle: a tenth of a frame at four.
    is_narrow = rows.is_cuda and rows.shape[-1] < 32
    if is_narrow or uses_reference_kernels() or torch.compiler.is_compiling():
        return _term_by_term(rows, ids, weights)
    return F.embedding_bag(ids, rows, per_sample_weights=weights, mode="sum")


def _term_by_term(rows: Tensor, ids: Tensor, weights: Tensor) -> Tensor:
    """The same, slower, with derivatives of any order."""
    total = rows.index_select(0, ids[:, 0]) * weights[:, :1]
    for k in range(1, ids.shape[-1]):
        total = total + rows.index_select(0, ids[:, k]) * weights[:, k, None]
    return total


def weighted_sums(
    values: Float[Tensor, "*values C size"], ids: Int[Tensor, "*ids P k"], weights: Float[Tensor, "*ids P k"]
) -> Float[Tensor, "*batch C P"]:
    """Weighted sums ``(*b, C, P)`` of few of the values ``(*b, C, size)``.

    Args:
        values: floating point.
        ids: ``(*b, P, k)``, or ``(P, k)`` for all of the batch: which k values are read for each of P sums.
        weights: of the ids' shape.

    Examples:
        >>> weighted_sums(torch.tensor([[1.0, 5.0]]), torch.tensor([[0, 1]]), torch.tensor([[0.25, 0.75]]))
        tensor([[4.]])
    """
    weights = weights.to(values.dtype)
    if ids.ndim > 2:
        batch = broadcast_shapes(values.shape[:-2], ids.shape[:-2])
        values = values.expand(*batch, *values.shape[-2:])
        shape = (*batch, values.shape[-2], ids.shape[-2])
        total = values.new_zeros(())
        for k in range(ids.shape[-1]):
            total = total + values.gather(-1, ids[..., None, :, k].expand(shape)) * weights[..., None, :, k]
        return total
    if ids.numel() < values.shape[-1]:  # few of many: the rest is not touched
        return (read_entries(values, ids) * weights).sum(-1)
    wants_grad = torch.is_grad_enabled() and (values.requires_grad or weights.requires_grad)
    if wants_grad and values.device.type == "cpu" and torch.compiler.is_compiling():
        # Inductor of torch 2.13 adds the slopes of transposed rows up at wrong places, and past their end.
        total = values.new_zeros(())
        for k in range(ids.shape[-1]):
            total = total + values.index_select(-1, ids[:, k]) * weights[:, k]
        return total
    # All channels of a value side by side, so that they are read at once.
    rows = values.reshape(math.prod(values.shape[:-1]), values.shape[-1]).t().contiguous()
    sums = (_term_by_term if wants_grad else weighted_rows)(rows, ids, weights)
    return sums.t().reshape(*values.shape[:-1], len(ids)).contiguous()


class PlacesInSinglePrecision(nn.Module):
    """A module whose tables are positions: in a network that is cast to half precision they become float32.

    Examples:
        >>> middle = Lookup(torch.tensor([[0, 1]]), torch.full((1, 2), 0.5)).half()
        >>> middle.weights.dtype
        torch.float32
    """

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        def exact(table: Tensor) -> Tensor:
            cast = fn(table)
            return table.to(cast.device, torch.float32) if cast.dtype in HALF else cast

        return super()._apply(exact, recurse)


class Lookup(PlacesInSinglePrecision):
    """Results that are weighted sums of k entries each, or one entry each, of any dtype.

    Args:
        ids: ``(*g, P, k)`` into the flattened source, or ``(*g, P)`` for one entry each, which are not weighted.
        weights: ``(*g, P, k)``; none with ids of one entry each.
        seen: ``(*g, P)``, where there is a result; everywhere if not given.
        dims: dimensions of the source that ids count through.

    Examples:
        >>> middle = Lookup(torch.tensor([[0, 1], [2, 3]]), torch.full((2, 2), 0.5))
        >>> middle(torch.tensor([[1.0, 3.0, 5.0, 7.0]]))
        tensor([[2., 6.]])
        >>> Lookup(torch.tensor([3, 0]), dims=2)(torch.tensor([[[1, 2], [3, 4]]]))
        tensor([[4, 1]])
    """

    ids: Tensor
    weights: Tensor | None
    seen: Tensor | None

    def __init__(
        self,
        ids: Int[Tensor, " ..."],
        weights: Float[Tensor, "*#g P k"] | None = None,
        seen: Bool[Tensor, "*#g P"] | None = None,
        dims: int = 1,
    ) -> None:
        super().__init__()
        self.dims = dims
        for name, table in (("ids", ids), ("weights", weights), ("seen", seen)):
            self.register_buffer(name, table, persistent=False)

    def forward(self, values: Shaped[Tensor, " ..."]) -> Shaped[Tensor, "*batch C P"]:
        """``values`` (*b, C, *source) at the targets, (*b, C, P)."""
        values = values.flatten(-self.dims)
        if self.weights is not None:
            result = weighted_sums(values, self.ids, self.weights)
        elif self.ids.ndim == 1:
            result = read_entries(values, self.ids)
        else:
            batch = broadcast_shapes(values.shape[:-2], self.ids.shape[:-1])
            ids = self.ids.unsqueeze(-2).expand(*batch, values.shape[-2], -1)
            result = values.expand(*batch, *values.shape[-2:]).gather(-1, ids)
        if self.seen is None:
            return result
        return torch.where(self.seen.unsqueeze(-2), result, result.new_zeros(()))
