# SPDX-License-Identifier: Apache-2.0
"""From the sweep's values of several cameras to one cost volume."""

from __future__ import annotations

import torch
from torch import Tensor

from sphericalvision.core import check_choice
from sphericalvision.sweep import SweepVolume

__all__ = ["AGGREGATIONS", "aggregated_channels", "concatenate_cameras", "mean_and_variance"]

AGGREGATIONS = ("concatenation", "variance")
"""How the values of the cameras become one volume."""


def concatenate_cameras(volume: SweepVolume) -> Tensor:
    """Return the channels of all cameras, one camera after the other: ``(B, n * C, N, V)``.

    What the paper does. A network on it is for one number of cameras.
    """
    return volume.values.flatten(1, 2)


def mean_and_variance(volume: SweepVolume) -> Tensor:
    """Return mean and variance over the cameras that see a point, and their share: ``(B, 2 * C + 1, N, V)``.

    The variance is small where the cameras agree. The result is the same in any order of the cameras, and of
    one shape for any number of them. Where no camera sees a point all is zero.

    References:
        Yao, Luo, Li, Fang and Quan (2018), "MVSNet: depth inference for unstructured multi-view stereo",
        equation 2 (there without masks).

    Examples:
        >>> values = torch.tensor([1.0, 3.0, 0.0]).view(1, 3, 1, 1, 1)  # three cameras, one channel, one point
        >>> mask = torch.tensor([True, True, False]).view(1, 3, 1, 1)
        >>> mean_and_variance(SweepVolume(values, mask)).flatten().tolist()  # mean, variance, share
        [2.0, 1.0, 0.666...]
    """
    values, mask = volume
    seen = mask.unsqueeze(2).to(values)
    count = seen.sum(1)
    divisor = count.clamp_min(1)
    # A camera at a time, which takes fewer passes over memory.
    cameras = list(zip(values.unbind(1), seen.unbind(1), strict=True))
    total = values.new_zeros(())
    for value, weight in cameras:
        total = torch.addcmul(total, value, weight)
    mean = total / divisor
    total = values.new_zeros(())
    for value, weight in cameras:
        total = torch.addcmul(total, (value - mean).square(), weight)
    return torch.cat((mean, total / divisor, count / values.shape[1]), 1)


def aggregated_channels(aggregation: str, channels: int, num_cameras: int) -> int:
    """Return the channels of the volume that an aggregation makes of ``channels`` of each camera.

    Examples:
        >>> aggregated_channels("concatenation", 32, 4), aggregated_channels("variance", 32, 4)
        (128, 65)
    """
    check_choice("aggregation", aggregation, AGGREGATIONS)
    return num_cameras * channels if aggregation == "concatenation" else 2 * channels + 1
