# SPDX-License-Identifier: Apache-2.0
"""VINS-Fusion's estimator YAML: poses of one or two cameras, and the names of their camodocal files beside it.

Convention:
    ``body_T_cam0`` takes coordinates of the camera to the IMU's, in metres; the IMU is the rig's world.

References:
    T. Qin, J. Pan, S. Cao, S. Shen, "A general optimization-based framework for local odometry estimation with multiple
    sensors", arXiv 1901.03638.
"""

from __future__ import annotations

import warnings

from sphericalvision.cameras.calibration import camodocal
from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat, has_any
from sphericalvision.cameras.calibration.keys import SETTINGS, Keys
from sphericalvision.core import FileFormatError, check_file, short_repr


def read(content: Keys, calibration: Calibration) -> None:
    """The cameras ``cam0`` and ``cam1`` of a parsed file, and their poses."""
    count = 2 if "cam1_calib" in content else 1
    if content.number("num_of_cam", count) != count:
        raise FileFormatError(
            f"{content.at('num_of_cam')}: expected {count}, as many as there are names of files"
        )
    if guessed := content.number("estimate_extrinsic", 0):
        warnings.warn(
            f"{content.at('estimate_extrinsic')}: {guessed:g} says that the poses are a first guess, which the program "
            "corrects; take those that it has found, and 0",
            stacklevel=5,
        )
    for index in range(count):
        name, key = f"cam{index}", f"cam{index}_calib"
        file_name = content.entry(key)
        if not isinstance(file_name, str) or not file_name or "\0" in file_name:
            raise FileFormatError(
                f"{content.at(key)}: expected the name of a file, got {short_repr(file_name)}"
            )
        file = check_file(
            calibration.path.parent / file_name, f"the calibration of {name}, which {content.where} names"
        )
        try:
            camera = camodocal.camera_in(file)
        except FileFormatError as error:
            raise FileFormatError(f"{error}; {content.where} names it for {name}") from error
        sides = ("image_width", "image_height")
        if any(side in content for side in sides) and content.size(*sides) != camera.image_size:
            raise FileFormatError(f"{content.at(*sides)}: differ from those of {file}; correct one")
        calibration.add(name, camera, str(file), content.pose(f"body_T_{name}"))


FileFormat(
    "vins",
    "VINS-Fusion estimator yaml",
    recognizes_keys=has_any("cam0_calib", "num_of_cam"),
    read_keys=read,
    ignored=SETTINGS
    + "(?!image_|cam|body|num_of_cam|extrinsic|distortion|projection|model).*|image\\d?_topic",
).register()
