# SPDX-License-Identifier: Apache-2.0
"""Errors of hypothesis indices and depths, means over the sphere, latitude profiles, and segmentation by area."""

from sphericalvision.metrics.depth import DepthError, DepthIndexError, depth_error, depth_index_error
from sphericalvision.metrics.sphere import (
    LatitudeBands,
    LatitudeProfile,
    SolidAngleIoU,
    SolidAngleMean,
    angular_error,
)

__all__ = [
    "DepthError",
    "DepthIndexError",
    "LatitudeBands",
    "LatitudeProfile",
    "SolidAngleIoU",
    "SolidAngleMean",
    "angular_error",
    "depth_error",
    "depth_index_error",
]
