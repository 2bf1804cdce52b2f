# SPDX-License-Identifier: Apache-2.0
"""The passes over memory that a normalisation takes: two each way in C++, in PyTorch several for each of these.

Values are ``(B, P, C)``, channels next to each other; statistics and factors ``(B or 1, 1, C)``, of each sample or of
all. Both ways give the same numbers but for rounding.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sphericalvision.crown.fast.native import native_operators

__all__ = ["NativePasses", "TorchPasses"]

CHUNK = 128
"""Places whose moments the operator takes at once; ``normalization.cpp`` has the same number."""


class TorchPasses:
    """In operations of PyTorch."""

    @staticmethod
    def moments(parts: Sequence[Tensor], per_sample: bool) -> tuple[Tensor, Tensor]:
        """Mean and biased variance of several tensors together."""
        over = (1,) if per_sample else (0, 1)
        number = _number(parts, per_sample)
        mean = torch.stack([x.sum(over, keepdim=True) for x in parts]).sum(0) / number
        # In two passes: the mean of squares less the square of the mean would lose what single precision has.
        squares = [(x - mean).square_().sum(over, keepdim=True) for x in parts]
        return mean, torch.stack(squares).sum(0) / number

    @staticmethod
    def scale_shift(values: Tensor, factor: Tensor, offset: Tensor, rectify: bool) -> Tensor:
        """``values * factor + offset``, rectified if asked for."""
        result = torch.addcmul(offset, values, factor)
        return result.relu_() if rectify else result

    @staticmethod
    def gradient_sums(
        gradient: Tensor, values: Tensor, rectified: Tensor | None, mean: Tensor, per_sample: bool
    ) -> tuple[Tensor, Tensor]:
        """Sums of a gradient and of its products with ``values - mean``, where ``rectified`` is positive."""
        over = (1,) if per_sample else (0, 1)
        gradient = _where_positive(gradient, rectified)
        along = (values - mean).mul_(gradient)
        return gradient.sum(over, keepdim=True), along.sum(over, keepdim=True)

    @staticmethod
    def gradient(
        gradient: Tensor,
        values: Tensor,
        rectified: Tensor | None,
        factor: Tensor,
        by_value: Tensor,
        constant: Tensor,
    ) -> Tensor:
        """``gradient * factor + values * by_value + constant``, where ``rectified`` is positive."""
        result = torch.addcmul(constant, values, by_value)
        return result.addcmul_(_where_positive(gradient, rectified), factor)


class NativePasses:
    """By operators in C++."""

    @staticmethod
    def moments(parts: Sequence[Tensor], per_sample: bool) -> tuple[Tensor, Tensor]:
        """Mean and biased variance of several tensors together.

        References:
            Chan, Golub and LeVeque (1983), "Algorithms for computing the sample variance", for moments of chunks.
        """
        over, number = ((1,) if per_sample else (0, 1)), _number(parts, per_sample)
        found = [_chunk_moments(x.contiguous()) for x in parts]
        mean = _sum([sums.sum(over, keepdim=True) for sums, _, _ in found]) / number
        squares = [
            (squares + (sums / sizes - mean).square() * sizes).sum(over, keepdim=True)
            for sums, squares, sizes in found
        ]
        return mean, _sum(squares) / number

    @staticmethod
    def scale_shift(values: Tensor, factor: Tensor, offset: Tensor, rectify: bool) -> Tensor:
        """``values * factor + offset``, rectified if asked for."""
        values = values.contiguous()
        result = torch.empty_like(values)
        native_operators().scale_shift(values, *_tables(factor, offset), rectify, result)
        return result

    @staticmethod
    def gradient_sums(
        gradient: Tensor, values: Tensor, rectified: Tensor | None, mean: Tensor, per_sample: bool
    ) -> tuple[Tensor, Tensor]:
        """Sums of a gradient and of its products with ``values - mean``, where ``rectified`` is positive."""
        over = (1,) if per_sample else (0, 1)
        totals = _of_chunks(values)
        along = torch.empty_like(totals)
        native_operators().gradient_sums(
            gradient.contiguous(), values.contiguous(), _contiguous(rectified), *_tables(mean), totals, along
        )
        return totals.sum(over, keepdim=True), along.sum(over, keepdim=True)

    @staticmethod
    def gradient(
        gradient: Tensor,
        values: Tensor,
        rectified: Tensor | None,
        factor: Tensor,
        by_value: Tensor,
        constant: Tensor,
    ) -> Tensor:
        """``gradient * factor + values * by_value + constant``, where ``rectified`` is positive."""
        values = values.contiguous()
        result, tables = torch.empty_like(values), _tables(factor, by_value, constant)
        native_operators().normalized_gradient(
            gradient.contiguous(), values, _contiguous(rectified), *tables, result
        )
        return result


def _sum(parts: Sequence[Tensor]) -> Tensor:
    """The sum of several tensors."""
    return torch.stack(list(parts)).sum(0)


def _number(parts: Sequence[Tensor], per_sample: bool) -> int:
    return sum(x.shape[1] * (1 if per_sample else len(x)) for x in parts)


def _where_positive(gradient: Tensor, rectified: Tensor | None) -> Tensor:
    return gradient if rectified is None else torch.ops.aten.threshold_backward(gradient, rectified, 0)


def _of_chunks(values: Tensor) -> Tensor:
    batch, places, channels = values.shape
    return values.new_empty(batch, -(-places // CHUNK), channels)


def _chunk_moments(values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sums and squared distances from the mean of each chunk, and its number of places."""
    sums = _of_chunks(values)
    squares = torch.empty_like(sums)
    native_operators().chunk_moments(values, sums, squares)
    sizes = sums.new_full((sums.shape[1], 1), CHUNK)
    sizes[-1] = values.shape[1] - CHUNK * (len(sizes) - 1)
    return sums, squares, sizes


def _tables(*tables: Tensor) -> list[Tensor]:
    return [table.flatten(0, 1).contiguous() for table in tables]


def _contiguous(values: Tensor | None) -> Tensor | None:
    return None if values is None else values.contiguous()
