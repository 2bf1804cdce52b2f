# SPDX-License-Identifier: Apache-2.0
"""What conversion and remapping ask of a camera beyond its verbs: its model alone, and more batch dimensions."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Camera, Projection


def project_by_model(camera: Camera, points: Float[Tensor, "*points 3"]) -> Projection:
    """Pixels (*, 2) of ``points`` (*, 3) by the model and where it is defined, borders and ``max_angle`` aside.

    Examples:
        >>> import torch
        >>> from sphericalvision.cameras import PinholeCamera
        >>> camera = PinholeCamera([100.0, 100.0], [1.5, 1.5], (4, 4))
        >>> project_by_model(camera, torch.tensor([1.0, 0.0, 1.0]))  # far beyond the image
        Projection(pixels=tensor([101.5000,   1.5000]), valid=tensor(True))
    """
    return camera._project(points)


def lifted(camera: Camera, batch: tuple[int, ...]) -> Camera:
    """The camera with leading dimensions of size one, as many as ``batch`` has more than it.

    Examples:
        >>> from sphericalvision.cameras import PinholeCamera
        >>> lifted(PinholeCamera([100.0, 100.0], [1.5, 1.5], (4, 4)), (5, 3)).batch_shape
        (1, 1)
    """
    missing = len(batch) - len(camera.batch_shape)
    return camera._map(lambda tensor: tensor.reshape(*[1] * missing, *tensor.shape)) if missing else camera
