# SPDX-License-Identifier: Apache-2.0
"""Normalisation of a crown by its own statistics in plain torch: of a batch, of groups of it, or of each sample."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from torch.nn.modules.batchnorm import _BatchNorm

from sphericalvision.tables import constant_table

Pair = tuple[Float[Tensor, "B 5 C *N long short"], Float[Tensor, "B 5 C *N short long"]]


class CrownNorm(_BatchNorm):
    """Parameters and running statistics of a normalisation whose statistics count both kinds of rectangles."""

    per_sample = False
    """Whether each sample is normalised by its own statistics."""
    groups = 1
    """Number of consecutive groups of samples in training, each normalised by its own statistics."""

    def _check_input_dim(self, input: Tensor) -> None:
        """Accept all: the crown is checked as a whole."""


def normalize(col: Tensor, row: Tensor, norm: CrownNorm, relu: bool) -> Pair:
    """Normalise rectangles ``(B, 5, C, [N,] h, w)`` of both kinds by their statistics, and rectify if asked for."""
    if norm.per_sample:
        return _by_sample(col, row, norm, relu)
    if norm.groups > 1:
        return _by_group(col, row, norm, relu)
    # Both kinds of rectangle have as many places: with the places in one dimension they are one batch.
    joined: Any = _BatchNorm.forward(norm, torch.cat([x.flatten(0, 1).flatten(-2) for x in (col, row)]))
    # Unlike unbind, its gradient keeps channels innermost
    first, second = (joined.relu() if relu else joined).chunk(2)
    return first.view(col.shape), second.view(row.shape)


def _by_sample(col: Tensor, row: Tensor, norm: CrownNorm, relu: bool) -> Pair:
    """Normalise each sample: channels of all samples side by side are the channels of one batch, of ten rectangles."""
    batch = col.shape[0]  # not `len`, which would make it a constant of an exported program
    if not batch:
        return col, row
    together = torch.cat([rectangles.flatten(-2) for rectangles in (col, row)], 1).transpose(0, 1)
    weight, bias = (None if x is None else x.repeat(batch) for x in (norm.weight, norm.bias))
    normalized = F.batch_norm(together.flatten(1, 2), None, None, weight, bias, True, eps=norm.eps)
    normalized = normalized.relu() if relu else normalized
    first, second = normalized.unflatten(1, (batch, -1)).transpose(0, 1).split(5, 1)
    return first.reshape(col.shape), second.reshape(row.shape)


def _by_group(col: Tensor, row: Tensor, norm: CrownNorm, relu: bool) -> Pair:
    """Normalise groups by statistics of their own, all at once: channels of all groups are those of one batch.

    Running statistics take a step for each group, as if one came after the other.
    """
    assert norm.running_mean is not None
    assert norm.running_var is not None
    assert norm.num_batches_tracked is not None
    assert norm.momentum is not None
    number = norm.groups
    together = torch.cat(
        [x.flatten(3).unflatten(0, (number, -1)).permute(1, 2, 0, 3, 4) for x in (col, row)], 1
    )
    mean, variance = (norm.running_mean.new_zeros(number * norm.num_features) for _ in range(2))
    weight, bias = (None if x is None else x.repeat(number) for x in (norm.weight, norm.bias))
    # (B, 10, groups, C, places). A step all the way makes running statistics of nothing those of the batch.
    flat = F.batch_norm(
        together.flatten(2, 3).flatten(0, 1), mean, variance, weight, bias, True, 1.0, norm.eps
    )
    flat = flat.relu() if relu else flat
    remaining, steps = (1 - norm.momentum) ** number, _steps(number, norm.momentum, mean.dtype, mean.device)
    with torch.no_grad():
        for running, batch in ((norm.running_mean, mean), (norm.running_var, variance)):
            running.copy_(torch.addmv(running, batch.view(number, -1).mT, steps, beta=remaining))
        norm.num_batches_tracked.add_(number)
    first, second = flat.view(together.shape).permute(2, 0, 1, 3, 4).flatten(0, 1).split(5, 1)
    return first.unflatten(-1, col.shape[3:]), second.unflatten(-1, row.shape[3:])


@constant_table
def _steps(number: int, momentum: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Weights of groups in running statistics that take a step for each, the last one the largest."""
    ages = torch.arange(number - 1, -1, -1, device=device)
    return (momentum * (1 - momentum) ** ages.double()).to(dtype)
