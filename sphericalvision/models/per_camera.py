# SPDX-License-Identifier: Apache-2.0
"""Features of the images of several cameras by one extractor."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

__all__ = ["camera_by_camera"]


def camera_by_camera(
    extractor: nn.Module, images: Float[Tensor, "B n 3 *size"]
) -> Float[Tensor, "B n C *size_of_features"]:
    """Return the features ``(B, n, C, *)`` of the images ``(B, n, 3, *)`` of n cameras.

    Statistics of the batch, which batch normalisation takes in training, are those of one camera at a time, and running
    statistics take one step a camera. Everything else sees no difference, and gets all cameras in one batch.

    References:
        Komatsu et al. (2020), "360° depth estimation from multiple fisheye images with origami crown
        representation of icosahedron", whose features are extracted so.

    Examples:
        >>> camera_by_camera(nn.Conv1d(3, 5, 1), torch.zeros(2, 4, 3, 42)).shape
        torch.Size([2, 4, 5, 42])
    """
    if any(map(_takes_statistics_of_the_batch, extractor.modules())):
        return torch.stack([extractor(camera) for camera in images.unbind(1)], 1)
    return extractor(images.flatten(0, 1)).unflatten(0, images.shape[:2])  # type: ignore[no-any-return]


def _takes_statistics_of_the_batch(part: nn.Module) -> bool:
    """Instance normalisation is of the same class, but keeps no running statistics."""
    return isinstance(part, _BatchNorm) and part.training and part.running_mean is not None
