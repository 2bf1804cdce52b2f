# SPDX-License-Identifier: Apache-2.0
"""Calibration files, one module a format: readers that recognise them, and writers."""

from sphericalvision.cameras.calibration import (  # noqa: F401  # each registers its format
    aria,
    asl,
    basalt,
    blender,
    camodocal,
    colmap,
    kalibr,
    kitti,
    metashape,
    multicol,
    native,
    nerfstudio,
    ocam_text,
    omnimvs,
    opencv,
    orbslam,
    py_ocamcalib,
    realitycapture,
    vins,
    woodscape,
)
from sphericalvision.cameras.calibration.basalt import read_basalt, write_basalt
from sphericalvision.cameras.calibration.colmap import write_colmap, write_colmap_rig
from sphericalvision.cameras.calibration.detect import read_camera, read_cameras, read_rig
from sphericalvision.cameras.calibration.kalibr import write_kalibr
from sphericalvision.cameras.calibration.native import write_camera, write_rig
from sphericalvision.cameras.calibration.ocam_text import read_ocam_folder, read_ocam_text, write_ocam_text
from sphericalvision.cameras.calibration.omnimvs import write_omnimvs
from sphericalvision.cameras.calibration.opencv_writer import write_opencv
from sphericalvision.cameras.calibration.save import camera_formats, rig_formats, save_camera, save_rig
from sphericalvision.cameras.calibration.trajectories import read_trajectory

__all__ = [
    "CAMERA_FORMATS",
    "RIG_FORMATS",
    "read_basalt",
    "read_camera",
    "read_cameras",
    "read_ocam_folder",
    "read_ocam_text",
    "read_rig",
    "read_trajectory",
    "save_camera",
    "save_rig",
    "write_basalt",
    "write_camera",
    "write_colmap",
    "write_colmap_rig",
    "write_kalibr",
    "write_ocam_text",
    "write_omnimvs",
    "write_opencv",
    "write_rig",
]

CAMERA_FORMATS = camera_formats()
"""Names of the formats in which ``save_camera`` writes."""
RIG_FORMATS = rig_formats()
"""Names of the formats in which ``save_rig`` writes."""
