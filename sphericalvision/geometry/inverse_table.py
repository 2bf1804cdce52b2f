# SPDX-License-Identifier: Apache-2.0
"""The inverse of an increasing function as a table: a start from which two steps find a root."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["InverseTable", "samples_towards", "tabulate_inverse"]


def _place(share: Tensor) -> Tensor:
    """From the share (*) of the largest value in [0, 1] to the place in the table, in [0, 1].

    The square root makes the inverse smooth where the function ends at a turning point.
    """
    return 1 - (1 - share).clamp(0, 1).sqrt()


class InverseTable(NamedTuple):
    """Arguments of an increasing function that starts at 0, for values from 0 to its largest; without derivatives."""

    limit: Float[Tensor, "*batch"]
    """The largest value (*b)."""
    knots: Float[Tensor, "*batch size"]
    """The arguments (*b, size)."""
    steps: Float[Tensor, "*batch size"]
    """From each argument to the next one, (*b, size)."""

    def lookup(self, value: Float[Tensor, " ..."]) -> Float[Tensor, " ..."]:
        """The argument (*b, *) of ``value`` (*b, *), interpolated; the last one for larger values.

        ``value`` has as many dimensions as ``limit`` and broadcasts with it; NaN gives the first argument.
        """
        with torch.no_grad():
            size = self.knots.shape[-1]
            place = (size - 1) * _place(value.detach() / self.limit).nan_to_num(0.0)
            below = place.floor()
            index = below.int()
            if self.limit.numel() > 1:
                tables = torch.arange(self.limit.numel(), dtype=torch.int32, device=index.device)
                index = index + size * tables.reshape(self.limit.shape)
            flat = index.reshape(-1)
            knot, step = (table.reshape(-1).index_select(0, flat) for table in (self.knots, self.steps))
            return torch.addcmul(knot.reshape(index.shape), place - below, step.reshape(index.shape))


def samples_towards(upper: Float[Tensor, "*batch"], samples: int = 512) -> Float[Tensor, "*batch n"]:
    """Arguments (*, samples) from 0 to ``upper`` (*), closer and closer, for ``tabulate_inverse``.

    Examples:
        >>> samples_towards(torch.tensor(16.0), 5).tolist()
        [0.0, 7.0, 12.0, 15.0, 16.0]
    """
    share = torch.linspace(1, 0, samples, dtype=upper.dtype, device=upper.device)
    return upper.unsqueeze(-1) * (1 - share * share)


def tabulate_inverse(
    arguments: Float[Tensor, "*#batch n"], values: Float[Tensor, "*batch n"], size: int = 512
) -> InverseTable:
    """Make the table of an increasing function from samples of it.

    Args:
        arguments: (*b, n) increasing, best ``samples_towards`` the last one.
        values: (*b, n) at the arguments, from 0 up. If the last one is a turning point of the function, the table is as
            good there as elsewhere.
        size: number of arguments in the table.

    Examples:
        >>> angle = samples_towards(torch.tensor(torch.pi / 2))
        >>> arcsine = tabulate_inverse(angle, angle.sin())  # which has an infinite slope at 1
        >>> sine = torch.tensor([0.0, 0.3, 0.99, 1.0])
        >>> (arcsine.lookup(sine) - sine.asin()).abs() < 1e-3
        tensor([True, True, True, True])
    """
    with torch.no_grad():
        arguments = arguments.expand(values.shape)
        places = _place(values / values[..., -1:]).contiguous()
        wanted = torch.linspace(0, 1, size, dtype=values.dtype, device=values.device)
        wanted = wanted + torch.zeros_like(places[..., :1])  # batched by vmap if the places are
        above = torch.searchsorted(places, wanted).clamp(1, values.shape[-1] - 1)
        low, high = places.gather(-1, above - 1), places.gather(-1, above)
        share = ((wanted - low) / (high - low)).nan_to_num(0.0).clamp(0, 1)
        knots = torch.lerp(arguments.gather(-1, above - 1), arguments.gather(-1, above), share)
        steps = torch.cat((knots.diff(dim=-1), torch.zeros_like(knots[..., :1])), dim=-1)
        return InverseTable(values[..., -1], knots, steps)
