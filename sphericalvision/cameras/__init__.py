# SPDX-License-Identifier: Apache-2.0
"""Camera models that work on directions, beyond 180° where the lens does, rigs of them, and calibration files."""

from sphericalvision.cameras.base import Camera, Projection, Unprojection
from sphericalvision.cameras.calibration import read_camera, read_rig, write_camera
from sphericalvision.cameras.double_sphere import (
    DoubleSphereCamera,
    project_double_sphere,
    unproject_double_sphere,
)
from sphericalvision.cameras.equirectangular import (
    EquirectangularCamera,
    project_equirectangular,
    unproject_equirectangular,
)
from sphericalvision.cameras.fisheye import FisheyeCamera, project_fisheye, unproject_fisheye
from sphericalvision.cameras.kannala_brandt import (
    KannalaBrandtCamera,
    project_kannala_brandt,
    unproject_kannala_brandt,
)
from sphericalvision.cameras.ocam import OCamCamera, project_ocam, unproject_ocam
from sphericalvision.cameras.pinhole import PinholeCamera, project_pinhole, unproject_pinhole
from sphericalvision.cameras.rig import CameraRig, ring_rig

__all__ = [
    "Camera",
    "CameraRig",
    "DoubleSphereCamera",
    "EquirectangularCamera",
    "FisheyeCamera",
    "KannalaBrandtCamera",
    "OCamCamera",
    "PinholeCamera",
    "Projection",
    "Unprojection",
    "project_double_sphere",
    "project_equirectangular",
    "project_fisheye",
    "project_kannala_brandt",
    "project_ocam",
    "project_pinhole",
    "read_camera",
    "read_rig",
    "ring_rig",
    "unproject_double_sphere",
    "unproject_equirectangular",
    "unproject_fisheye",
    "unproject_kannala_brandt",
    "unproject_ocam",
    "unproject_pinhole",
    "write_camera",
]
