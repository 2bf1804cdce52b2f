# SPDX-License-Identifier: Apache-2.0
"""Normalisation of a crown by statistics over the rectangles of both directions together."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.modules.batchnorm import _BatchNorm

from sphericalvision.core import check_choice, check_dtype
from sphericalvision.crown.fast import normalize
from sphericalvision.crown.layout import Crown, check_crown, crown_map, crown_relu
from sphericalvision.crown.statistics import CrownNorm


class _CrownBatchNorm(CrownNorm):
    """Batch normalisation whose statistics count every place, border vertices as often as they occur."""

    spatial_dims: int

    def forward(self, crown: Crown) -> Crown:  # type: ignore[override]
        return self.normalize(crown)

    def normalize(self, crown: Crown, relu: bool = False) -> Crown:
        """Normalise a crown, and rectify it if asked for."""
        check_crown(crown, self.spatial_dims, self.num_features)
        if self.affine:
            check_dtype("crown", crown.col, self.weight)
        if not self.is_affine:
            return Crown(*normalize(*crown, self, relu))
        layer = _BatchNorm.forward  # of torch
        normalized = crown_map(lambda r: layer(self, r.flatten(0, 1).flatten(-2)).view(r.shape), crown)
        return crown_relu(normalized) if relu else normalized

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


class CrownInstanceNorm2d(_CrownInstanceNorm):
    """Instance normalisation of a crown ``(B, 5, C, h, w)``: the statistics of each sample over both directions.

    For training with a batch of one or two, whose statistics vary too much from batch to batch.

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
