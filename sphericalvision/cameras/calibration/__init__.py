# SPDX-License-Identifier: Apache-2.0
"""Readers of calibration files, one a format."""

from sphericalvision.cameras.calibration.basalt import read_basalt
from sphericalvision.cameras.calibration.detect import read_camera, read_rig
from sphericalvision.cameras.calibration.native import write_camera, write_rig
from sphericalvision.cameras.calibration.ocam_text import read_ocam_folder, read_ocam_text

__all__ = [
    "read_basalt",
    "read_camera",
    "read_ocam_folder",
    "read_ocam_text",
    "read_rig",
    "write_camera",
    "write_rig",
]
