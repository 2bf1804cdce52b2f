# SPDX-License-Identifier: Apache-2.0
"""Normalisation of a crown: one set of statistics over the rectangles of both directions."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.nn.modules.batchnorm import _BatchNorm

from sphericalvision.core import ShapeError, check_choice, check_dtype
from sphericalvision.crown.fast import normalize
from sphericalvision.crown.layout import Crown, check_crown, crown_map, crown_relu
from sphericalvision.kernels import prefer_fused
from sphericalvision.tables import constant_table

__all__ = ["CrownBatchNorm2d", "CrownBatchNorm3d", "CrownInstanceNorm2d", "CrownInstanceNorm3d", "crown_norm"]


class _CrownBatchNorm(_BatchNorm):
    """Batch normalisation whose statistics count every place, border vertices as often as they occur."""

    spatial_dims: int
    per_sample = False
    groups = 1
    """In how many groups, one after another, samples come to training, of which each has statistics of its own."""

    def _check_input_dim(self, input: Tensor) -> None:
        """Accept all: the crown is checked as a whole in ``forward``."""

    def forward(self, crown: Crown) -> Crown:  # type: ignore[override]
        return self.normalize(crown)

    def normalize(self, crown: Crown, relu: bool = False) -> Crown:
        """Normalise a crown, and rectify it if asked for."""
        check_crown(crown, self.spatial_dims)
        if crown.col.shape[2] != self.num_features:
            raise ShapeError(
                f"crown: expected {self.num_features} channels (dimension 2), got {crown.col.shape[2]}"
            )
        if self.affine:
            check_dtype("crown", crown.col, self.weight)
        pair = None if self.is_affine else normalize(*crown, self, self.per_sample, relu)
        if pair is not None:
            return Crown(*pair)
        return self._plainly(crown, relu)

    def _plainly(self, crown: Crown, relu: bool) -> Crown:
        if self.is_affine:
            normalized = crown_map(lambda r: self._layer(r.flatten(0, 1).flatten(-2)).view(r.shape), crown)
            return crown_relu(normalized) if relu else normalized
        if self.groups > 1:
            return self._by_groups(crown, relu)
        # Both kinds of rectangle have as many places: with the places in one dimension they are one batch.
        col, row = (rectangles.flatten(0, 1).flatten(-2) for rectangles in crown)
        both = self._layer(torch.cat((col, row)))
        both = both.relu() if relu else both
        col, row = both.chunk(2)  # unlike unbind, its gradient keeps the channels innermost in memory
        return Crown(col.view(crown.col.shape), row.view(crown.row.shape))

    def _by_groups(self, crown: Crown, relu: bool) -> Crown:
        """Normalise groups by statistics of their own, all at once: channels of all groups are those of one batch.

        Running statistics take a step for each group, as if one came after the other.
        """
        assert self.running_mean is not None
        assert self.running_var is not None
        assert self.num_batches_tracked is not None
        assert self.momentum is not None
        number = self.groups
        parts = [
            rectangles.flatten(3).unflatten(0, (number, -1)).permute(1, 2, 0, 3, 4) for rectangles in crown
        ]
        together = torch.cat(parts, 1)  # (B, 10, groups, C, places)
        mean, variance = (self.running_mean.new_zeros(number * self.num_features) for _ in range(2))
        weight, bias = (None if x is None else x.repeat(number) for x in (self.weight, self.bias))
        # A step all the way makes running statistics of nothing those of the batch.
        flat = F.batch_norm(
            together.flatten(2, 3).flatten(0, 1), mean, variance, weight, bias, True, 1.0, self.eps
        )
        flat = flat.relu() if relu else flat
        left, steps = (1 - self.momentum) ** number, _steps(number, self.momentum, mean.dtype, mean.device)
        with torch.no_grad():
            for running, batch in ((self.running_mean, mean), (self.running_var, variance)):
                taken = torch.addmv(running, batch.view(number, -1).mT, steps, beta=left)
                running.copy_(taken)
            self.num_batches_tracked.add_(number)
        normalized = flat.view(together.shape).permute(2, 0, 1, 3, 4).flatten(0, 1)
        return Crown(
            *(x.unflatten(-1, like.shape[3:]) for x, like in zip(normalized.split(5, 1), crown, strict=True))
        )

    def _layer(self, values: Tensor) -> Tensor:
        """The layer of torch."""
        return super().forward(values)

    @property
    def is_affine(self) -> bool:
        """Whether it is one multiplication and one addition a channel, as batch normalisation is in evaluation."""
        return not self.training and self.running_var is not None

    def folded(self, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Weight ``(out, in, taps)`` and bias of a convolution that normalises, too, where ``is_affine``."""
        assert self.running_mean is not None
        assert self.running_var is not None
        scale = (self.running_var + self.eps).rsqrt()
        if self.weight is not None:
            scale = scale * self.weight
        bias = torch.zeros_like(scale) if self.bias is None else self.bias
        return weight * scale[:, None, None], torch.addcmul(bias, self.running_mean, scale, value=-1)


@constant_table
def _steps(number: int, momentum: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Weights of groups in running statistics that take a step for each, the last one the largest."""
    ages = torch.arange(number - 1, -1, -1, device=device)
    return (momentum * (1 - momentum) ** ages.double()).to(dtype)


class CrownBatchNorm2d(_CrownBatchNorm):
    """Batch normalisation of a crown ``(B, 5, C, h, w)`` over both directions together.

    Arguments, parameters and running statistics are those of ``torch.nn.BatchNorm2d``.

    Raises:
        ShapeError: if the crown is no crown of C channels without hypotheses.

    References:
        Ioffe and Szegedy (2015), "Batch normalization".

    Examples:
        >>> from sphericalvision.crown import to_crown
        >>> crown = CrownBatchNorm2d(3)(to_crown(torch.rand(2, 3, 42)))
        >>> bool(torch.cat((crown.col.flatten(), crown.row.flatten())).mean().abs() < 1e-6)
        True
    """

    spatial_dims = 2


class CrownBatchNorm3d(_CrownBatchNorm):
    """Batch normalisation of a crown of volumes ``(B, 5, C, N, h, w)`` over both directions together.

    Arguments, parameters and running statistics are those of ``torch.nn.BatchNorm3d``.

    Raises:
        ShapeError: if the crown is no crown of C channels with hypotheses.

    Examples:
        >>> from sphericalvision.crown import to_crown
        >>> CrownBatchNorm3d(3)(to_crown(torch.rand(2, 3, 8, 42))).col.shape
        torch.Size([2, 5, 3, 8, 5, 3])
    """

    spatial_dims = 3


class _CrownInstanceNorm(_CrownBatchNorm):
    """Batch normalisation of one sample at a time by its own statistics, in training and evaluation alike."""

    per_sample = True

    def __init__(self, num_features: int, eps: float = 1e-5) -> None:
        super().__init__(num_features, eps, track_running_stats=False)

    def _plainly(self, crown: Crown, relu: bool) -> Crown:
        # Channels of all samples side by side are the channels of one batch, of ten rectangles.
        batch = crown.col.shape[0]  # not `len`, which would make it a constant of an exported program
        if not batch:
            return crown
        if prefer_fused(crown.col.device):  # a group for each channel
            together = torch.cat([rectangles.transpose(1, 2).flatten(-2) for rectangles in crown], 2)
            normalized = F.group_norm(together, self.num_features, self.weight, self.bias, self.eps)
            normalized = normalized.relu() if relu else normalized
            col, row = normalized.transpose(1, 2).split(5, 1)
            return Crown(
                *(x.unflatten(-1, like.shape[-2:]) for x, like in zip((col, row), crown, strict=True))
            )
        together = torch.cat([rectangles.flatten(-2) for rectangles in crown], 1).transpose(0, 1)
        weight, bias = (None if x is None else x.repeat(batch) for x in (self.weight, self.bias))
        normalized = F.batch_norm(together.flatten(1, 2), None, None, weight, bias, True, eps=self.eps)
        normalized = normalized.relu() if relu else normalized
        col, row = normalized.unflatten(1, (batch, -1)).transpose(0, 1).split(5, 1)
        return Crown(col.reshape(crown.col.shape), row.reshape(crown.row.shape))


class CrownInstanceNorm2d(_CrownInstanceNorm):
    """Instance normalisation of a crown ``(B, 5, C, h, w)``: the statistics of each sample over both directions.

    The choice for training with a batch of one or two, where statistics of a batch tell little of the next one.

    Args:
        num_features: C.
        eps: added to the variance.

    References:
        Ulyanov, Vedaldi and Lempitsky (2016), "Instance normalization".

    Examples:
        >>> from sphericalvision.crown import to_crown
        >>> values = torch.rand(2, 3, 42)
        >>> pair, alone = CrownInstanceNorm2d(3)(to_crown(values)), CrownInstanceNorm2d(3)(to_crown(values[:1]))
        >>> torch.equal(pair.col[:1], alone.col)
        True
    """

    spatial_dims = 2


class CrownInstanceNorm3d(_CrownInstanceNorm):
    """Instance normalisation of a crown of volumes ``(B, 5, C, N, h, w)``; see ``CrownInstanceNorm2d``.

    Examples:
        >>> from sphericalvision.crown import FromCrown, ToCrown
        >>> volume = FromCrown()(CrownInstanceNorm3d(4)(ToCrown()(torch.rand(1, 4, 8, 162))))
        >>> volume.shape
        torch.Size([1, 4, 8, 162])
    """

    spatial_dims = 3


NORMS = ("batch", "instance")


def crown_norm(kind: str, spatial_dims: int, num_features: int) -> _CrownBatchNorm:
    """Return the ``"batch"`` or ``"instance"`` normalisation of crowns (2) or of crowns of volumes (3).

    Examples:
        >>> crown_norm("batch", 2, 8)
        CrownBatchNorm2d(8, ...)
    """
    check_choice("norm", kind, NORMS)
    if kind == "batch":
        return (CrownBatchNorm2d if spatial_dims == 2 else CrownBatchNorm3d)(num_features)
    return (CrownInstanceNorm2d if spatial_dims == 2 else CrownInstanceNorm3d)(num_features)
