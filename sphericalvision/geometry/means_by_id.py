# SPDX-License-Identifier: Apache-2.0
"""Means over all places that hold the same id, by lookups alone: what adds up into places is slow in other runtimes."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor


class MeansById(NamedTuple):
    """Where the places of each id are, for ids most of which have equally many places.

    Attributes:
        reads: ``(k * size + m * E,)`` places: k of each id, the most frequent number of them, of other ids any; then
            those of the E ids that have another number, m at most.
        size: number of ids.
        shares: ``(m, E)`` of the latter in the mean.
        others: ``(E,)`` these ids.
    """

    reads: Int[Tensor, " reads"]
    size: int
    shares: Float[Tensor, "m E"]
    others: Int[Tensor, " E"]


def means_by_id(ids: Int[Tensor, " P"], size: int, dtype: torch.dtype = torch.float32) -> MeansById:
    """Return the tables of P places with ids from 0 to size - 1, each of which occurs, for values of a type.

    Examples:
        >>> means_by_id(torch.tensor([1, 0, 1, 0, 1]), 2).reads
        tensor([1, 0, 3, 2, 0, 2, 4])
    """
    counts = ids.bincount(minlength=size)
    first = counts.cumsum(0) - counts
    in_order = ids.argsort(stable=True)
    usual, most = int(counts.mode().values), int(counts.max())

    def table(of: Tensor, width: int) -> tuple[Tensor, Tensor]:
        number = torch.arange(width, device=ids.device)[:, None]
        present = number < counts[of]
        members = in_order[(first[of] + number).clamp(max=len(ids) - 1)].where(present, 0)
        return members, present / counts[of].to(dtype)

    every = torch.arange(size, device=ids.device)
    others = (counts != usual).nonzero()[:, 0]
    more, shares = table(others, most)
    return MeansById(torch.cat((table(every, usual)[0].flatten(), more.flatten())), size, shares, others)


def mean_by_id(values: Float[Tensor, "*batch P"], tables: MeansById) -> Float[Tensor, "*batch size"]:
    """Return the mean ``(*, size)`` of values ``(*, P)`` over the places of each id.

    Examples:
        >>> mean_by_id(torch.tensor([1.0, 2.0, 3.0, 4.0, 8.0]), means_by_id(torch.tensor([1, 0, 1, 0, 1]), 2))
        tensor([3., 4.])
    """
    number = tables.shares.numel()
    usual, more = values.index_select(-1, tables.reads).split((len(tables.reads) - number, number), -1)
    means = usual.unflatten(-1, (-1, tables.size)).mean(-2)
    if not number:
        return means
    more = (more.unflatten(-1, tuple(tables.shares.shape)) * tables.shares.to(values.dtype)).sum(-2)
    return means.index_copy_(-1, tables.others, more.to(means.dtype))  # autocast sums in float32
