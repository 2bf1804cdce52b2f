# SPDX-License-Identifier: Apache-2.0
"""Camera models that work on directions, beyond 180° where the lens does, and rigs of them."""

from sphericalvision.cameras.base import Camera, Projection, Unprojection
from sphericalvision.cameras.equirectangular import (
    EquirectangularCamera,
    project_equirectangular,
    unproject_equirectangular,
)
from sphericalvision.cameras.fisheye import FisheyeCamera, project_fisheye, unproject_fisheye
from sphericalvision.cameras.rig import CameraRig, ring_rig

__all__ = [
    "Camera",
    "CameraRig",
    "EquirectangularCamera",
    "FisheyeCamera",
    "Projection",
    "Unprojection",
    "project_equirectangular",
    "project_fisheye",
    "ring_rig",
    "unproject_equirectangular",
    "unproject_fisheye",
]
