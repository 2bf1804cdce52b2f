# SPDX-License-Identifier: Apache-2.0
"""Gyroflow's lens profiles: one camera of ``cv2.fisheye``.

Convention:
    ``camera_matrix`` is that of images of ``calib_dimension``, which is the size of the camera here: resize it for
    videos of ``orig_dimension``. Unless ``asymmetrical``, the principal point is the middle of the image, as Gyroflow
    takes it, whatever the matrix says.

References:
    https://docs.gyroflow.xyz/app/getting-started/lens-calibration
"""

from __future__ import annotations

from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat, has_all
from sphericalvision.cameras.calibration.keys import Keys
from sphericalvision.cameras.calibration.lenses import distorted
from sphericalvision.cameras.calibration.parsing import camera_matrix
from sphericalvision.core import FileFormatError


def read(content: Keys, calibration: Calibration) -> None:
    """The camera of a parsed file."""
    if content.get("distortion_model"):
        content.chosen("distortion_model", ("opencv_fisheye",))
    for key in ("input_horizontal_stretch", "input_vertical_stretch"):
        if content.get(key) and content.number(key) != 1:
            raise FileFormatError(f"{content.at(key)}: expected 1, got {content[key]!r:.80}")
    for key in ("digital_lens", "interpolations", "use_opencv_standard"):
        if content.get(key):
            raise FileFormatError(f"{content.at(key)}: expected none, got {content[key]!r:.80}")
    lens = content.inner("fisheye_params")
    height, width = size = content.inner("calib_dimension").size("w", "h")
    plane, skew = camera_matrix(lens.matrix("camera_matrix", 9), lens.at("camera_matrix"), has_skew=True)
    if content.get("asymmetrical") is not True:
        plane[2:] = width / 2, height / 2
    numbers = [*plane, *lens.matrix("distortion_coeffs", 4)]
    camera = distorted("equidistant", numbers, size, content.where, skew)
    calibration.add(calibration.path.stem, camera, content.where)


FileFormat(
    "gyroflow",
    "Gyroflow lens profile",
    recognizes_keys=has_all("fisheye_params", "calib_dimension"),
    read_keys=read,
    ignored=r"(?!(calib|crop|input|distortion|asym|digital_lens$|interpol|fisheye))[^/]+"
    r"|(calib_dimension|fisheye_params)/(radial_distortion_limit|RMS_error)|calibrated_by|calibrator_version|crop_factor|crop",
).register()
