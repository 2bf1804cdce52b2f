# SPDX-License-Identifier: Apache-2.0
"""The evaluation protocol of OmniMVS: inverse depth on a panorama, within 45 degrees of the horizon, N = 192."""

from __future__ import annotations

from jaxtyping import Float, Shaped
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.metrics.depth_errors import depth_index_error
from sphericalvision.shapes import check_shapes

NUM_HYPOTHESES = 192


@check_shapes
def omnimvs_error(
    pred_inverse_depth: Float[Tensor, "B h w"],
    target_inverse_depth: Float[Tensor, "B h w"],
    min_depth: float = 0.55,
    mask: Shaped[Tensor, "B h w"] | None = None,
) -> dict[str, Float[Tensor, " B"]]:
    """Return ``>1 >3 >5 MAE RMS`` of each image by the official protocol, in percent of N.

    Inverse depths become indices ``(N - 1) * min_depth / depth``, neither rounded. Of a full panorama only the rows
    within 45 degrees of the horizon count, each pixel the same; points whose true index is above N are left out.

    Args:
        pred_inverse_depth: ``(B, h, w)`` in 1/m on a panorama: w = 2h is the full sphere, w = 4h the latitudes
            within 45 degrees; NaN is an infinite error.
        target_inverse_depth: ``(B, h, w)``; 0 is infinity, NaN is left out.
        min_depth: nearest hypothesis in metres.
        mask: ``(B, h, w)``, True where the truth counts; everywhere when not given.

    Returns:
        The five errors ``(B,)``; NaN for an image without a valid point.

    Raises:
        ShapeError: if shapes do not agree or are no panoramas.
        ArgumentError: if ``min_depth`` is not positive.

    References:
        Won, Ryu and Lim (2019), "OmniMVS: end-to-end learning for omnidirectional stereo matching", section 4, and
        its published evaluation on 160 x 640 panoramas.

    Examples:
        >>> import torch
        >>> truth = torch.full((1, 4, 8), 1.0)
        >>> errors = omnimvs_error(truth + 0.05, truth, min_depth=0.5)
        >>> round(errors["MAE"].item(), 3)  # 0.05 1/m are 4.775 of 192 indices
        2.487
    """
    if not min_depth > 0:
        raise ArgumentError(f"min_depth: expected a positive number of metres, got {min_depth!r}")
    index_from_inverse = (NUM_HYPOTHESES - 1) * min_depth
    pred, target = (
        _near_horizon(x).double() * index_from_inverse for x in (pred_inverse_depth, target_inverse_depth)
    )
    counts = (target >= 0) & (target <= NUM_HYPOTHESES)
    if mask is not None:
        counts = counts & _near_horizon(mask).bool()
    return depth_index_error(pred, target, NUM_HYPOTHESES, counts)


def _near_horizon(panorama: Tensor) -> Tensor:
    """The rows ``(B, pixels)`` within 45 degrees of the horizon."""
    height, width = panorama.shape[-2:]
    if width == 4 * height > 0:
        return panorama.flatten(1)
    if width == 2 * height > 0 and height % 4 == 0:
        return panorama[:, height // 4 : 3 * height // 4].flatten(1)
    raise ShapeError(
        "pred_inverse_depth: expected (B, h, w) with w = 4h, or w = 2h and h a multiple of 4, got "
        f"{tuple(panorama.shape)}"
    )
