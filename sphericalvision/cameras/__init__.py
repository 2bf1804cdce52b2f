# SPDX-License-Identifier: Apache-2.0
"""Camera models that work on directions, beyond 180° where the lens does, rigs of them, and calibration files."""

from importlib import import_module
from typing import Any

from sphericalvision.cameras import sphere_images as _sphere_images  # noqa: F401  # CameraRig.sample_sphere
from sphericalvision.cameras.base import Camera, Projection, Unprojection
from sphericalvision.cameras.calibration import (
    read_camera,
    read_cameras,
    read_rig,
    read_trajectory,
    save_camera,
    save_rig,
)
from sphericalvision.cameras.conversion.convert import convert, fit_inverse_polynomial
from sphericalvision.cameras.conversion.straighten import straighten, straighten_rig
from sphericalvision.cameras.coverage import coverage, overlap, seen_by
from sphericalvision.cameras.depth import depth_from_z, points_from_depth, z_from_depth
from sphericalvision.cameras.field_of_view import field_of_view
from sphericalvision.cameras.kornia_cameras import CameraModule, from_kornia, to_kornia
from sphericalvision.cameras.models.angle_polynomial import (
    AnglePolynomialCamera,
    project_angle_polynomial,
    unproject_angle_polynomial,
)
from sphericalvision.cameras.models.atan import AtanCamera, project_atan, unproject_atan
from sphericalvision.cameras.models.brown_conrady import (
    BrownConradyCamera,
    project_brown_conrady,
    unproject_brown_conrady,
)
from sphericalvision.cameras.models.division import DivisionCamera, project_division, unproject_division
from sphericalvision.cameras.models.double_sphere import (
    DoubleSphereCamera,
    project_double_sphere,
    unproject_double_sphere,
)
from sphericalvision.cameras.models.equirectangular import (
    EquirectangularCamera,
    project_equirectangular,
    unproject_equirectangular,
)
from sphericalvision.cameras.models.extended_unified import (
    ExtendedUnifiedCamera,
    project_extended_unified,
    unproject_extended_unified,
)
from sphericalvision.cameras.models.fisheye import FisheyeCamera, project_fisheye, unproject_fisheye
from sphericalvision.cameras.models.kannala_brandt import (
    KannalaBrandtCamera,
    project_kannala_brandt,
    unproject_kannala_brandt,
)
from sphericalvision.cameras.models.ocam import OCamCamera, project_ocam, unproject_ocam
from sphericalvision.cameras.models.pinhole import PinholeCamera, project_pinhole, unproject_pinhole
from sphericalvision.cameras.models.radial_polynomial import (
    RadialPolynomialCamera,
    project_radial_polynomial,
    unproject_radial_polynomial,
)
from sphericalvision.cameras.models.thin_prism_fisheye import (
    ThinPrismFisheyeCamera,
    project_thin_prism_fisheye,
    unproject_thin_prism_fisheye,
)
from sphericalvision.cameras.models.unified import UnifiedCamera, project_unified, unproject_unified
from sphericalvision.cameras.registry import register_camera
from sphericalvision.cameras.remapping.remap import Remap, remap, remap_mask
from sphericalvision.cameras.remapping.undistort import undistort, undistorted_camera
from sphericalvision.cameras.remapping.views import perspective_views
from sphericalvision.cameras.rig import CameraRig, ring_rig
from sphericalvision.cameras.trajectory import Trajectory

__all__ = [
    "AnglePolynomialCamera",
    "AtanCamera",
    "BrownConradyCamera",
    "Camera",
    "CameraModule",
    "CameraRig",
    "DivisionCamera",
    "DoubleSphereCamera",
    "EquirectangularCamera",
    "ExtendedUnifiedCamera",
    "FisheyeCamera",
    "KannalaBrandtCamera",
    "OCamCamera",
    "PinholeCamera",
    "Projection",
    "RadialPolynomialCamera",
    "Remap",
    "ThinPrismFisheyeCamera",
    "Trajectory",
    "UnifiedCamera",
    "Unprojection",
    "convert",
    "coverage",
    "depth_from_z",
    "field_of_view",
    "fit_inverse_polynomial",
    "from_kornia",
    "overlap",
    "perspective_views",
    "points_from_depth",
    "project_angle_polynomial",
    "project_atan",
    "project_brown_conrady",
    "project_division",
    "project_double_sphere",
    "project_equirectangular",
    "project_extended_unified",
    "project_fisheye",
    "project_kannala_brandt",
    "project_ocam",
    "project_pinhole",
    "project_radial_polynomial",
    "project_thin_prism_fisheye",
    "project_unified",
    "read_camera",
    "read_cameras",
    "read_rig",
    "read_trajectory",
    "register_camera",
    "remap",
    "remap_mask",
    "ring_rig",
    "save_camera",
    "save_rig",
    "seen_by",
    "straighten",
    "straighten_rig",
    "to_kornia",
    "undistort",
    "undistorted_camera",
    "unproject_angle_polynomial",
    "unproject_atan",
    "unproject_brown_conrady",
    "unproject_division",
    "unproject_double_sphere",
    "unproject_equirectangular",
    "unproject_extended_unified",
    "unproject_fisheye",
    "unproject_kannala_brandt",
    "unproject_ocam",
    "unproject_pinhole",
    "unproject_radial_polynomial",
    "unproject_thin_prism_fisheye",
    "unproject_unified",
    "z_from_depth",
]

_MOVED = (
    "OwnBody",
    "PhotometricCalibration",
    "RayMatcher",
    "RayMatches",
    "align_rig",
    "align_rig_direct",
    "calibrate_camera",
    "calibrate_photometry",
    "find_own_body",
    "refine",
    "refine_rig",
)
"""Names that are in ``sphericalvision.capture`` since, and may still be asked for here."""


def __getattr__(name: str) -> Any:
    if name in _MOVED:
        return getattr(import_module("sphericalvision.capture"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
