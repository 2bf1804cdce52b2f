# SPDX-License-Identifier: Apache-2.0
"""Errors of hypothesis indices and depths, where they count, means over the sphere, and segmentation by area."""

from sphericalvision.metrics.depth import DepthError, DepthIndexError, depth_error, depth_index_error
from sphericalvision.metrics.masks import evaluation_mask, seam_mask
from sphericalvision.metrics.omnimvs import OmniMVSError, omnimvs_error
from sphericalvision.metrics.regions import ByRegion
from sphericalvision.metrics.sphere import LatitudeProfile, SolidAngleIoU, SolidAngleMean, angular_error

__all__ = [
    "ByRegion",
    "DepthError",
    "DepthIndexError",
    "LatitudeProfile",
    "OmniMVSError",
    "SolidAngleIoU",
    "SolidAngleMean",
    "angular_error",
    "depth_error",
    "depth_index_error",
    "evaluation_mask",
    "omnimvs_error",
    "seam_mask",
]
