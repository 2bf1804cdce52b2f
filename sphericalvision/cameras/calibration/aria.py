# SPDX-License-Identifier: Apache-2.0
"""Project Aria's device calibration (json): fisheye cameras of a pair of glasses, with poses.

Convention:
    A camera of ``CameraCalibrations`` is called by its ``Label``. ``Params`` of ``FisheyeRadTanThinPrism`` are f cx cy,
    k0 to k5, p0 p1, s0 to s3, where p0 and p1 are OpenCV's p2 and p1; of ``KannalaBrandtK3`` fx fy cx cy, k0 to k3.
    ``T_Device_Camera`` takes coordinates of the camera to the device's, in metres; the device is the rig's world. Its
    quaternion is [w, [x, y, z]]. Centres of pixels have whole coordinates.

    The file does not tell sizes. They are those of the sensors in full, by label, if the principal
    point is in their middle, unless ``image_size`` is given.

References:
    J. Engel et al., "Project Aria: a new tool for egocentric multi-modal AI research", arXiv 2308.13561.
"""

from __future__ import annotations

import warnings

from torch import Tensor

from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat, has_all
from sphericalvision.cameras.calibration.keys import Keys
from sphericalvision.cameras.calibration.lenses import Lens, lens_called
from sphericalvision.cameras.calibration.parsing import numbers
from sphericalvision.cameras.calibration.poses import transform_from_numbers
from sphericalvision.core import FileFormatError, short_repr

_LENSES = (
    Lens(
        "FisheyeRadTanThinPrism",
        "thin_prism_fisheye",
        "f cx cy k1 k2 k3 k4 k5 k6 p2 p1 s1 s2 s3 s4",
        options={"composition": "sequential"},
    ),
    Lens("KannalaBrandtK3", "kannala_brandt", "fx fy cx cy k1 k2 k3 k4"),
)
_SIZES = {"camera-slam": (480, 640), "camera-rgb": (2880, 2880), "camera-et": (240, 320)}
"""(height, width) by the beginning of the label."""


def read(content: Keys, calibration: Calibration) -> None:
    """Cameras and poses of a parsed file."""
    nominal = []
    for values in content.several("CameraCalibrations"):
        label, projection = values.entry("Label"), values.inner("Projection")
        if not isinstance(label, str):
            raise FileFormatError(f"{values.at('Label')}: expected a name, got {short_repr(label)}")
        lens = lens_called(_LENSES, projection.chosen("Name", [lens.name for lens in _LENSES]))
        numbers = projection.numbers("Params", len(lens.keys))
        u, v = numbers[lens.names.index("cx") :][:2]
        sizes = (  # where the axis meets the sensor elsewhere, the numbers are of another size
            (height, width)
            for start, (height, width) in _SIZES.items()
            if label.startswith(start) and max(abs(u / width - 0.5), abs(v / height - 0.5)) < 0.1
        )
        size = calibration.options.image_size or next(sizes, None)
        size = size or calibration.options.given_size(f"{projection.where} of {label!r}")
        camera = lens.camera(numbers, size, projection.where)
        calibration.add(label, camera, values.where, _pose(values.inner("T_Device_Camera")))
        if not values.get("Calibrated", True):
            nominal.append(label)
    if nominal:
        warnings.warn(
            f"{content.where}: {', '.join(nominal)[:200]}: Calibrated is false: numbers of a design, not of these "
            "cameras",
            stacklevel=5,
        )


def _pose(values: Keys) -> Tensor:
    translation, quaternion = values.numbers("Translation", 3), values.entry("UnitQuaternion")
    where = values.at("UnitQuaternion")
    if not isinstance(quaternion, list) or len(quaternion) != 2:
        raise FileFormatError(f"{where}: expected [w, [x, y, z]], got {short_repr(quaternion)}")
    wxyz = [*numbers(quaternion[0], where, 1), *numbers(quaternion[1], where, 3)]
    return transform_from_numbers(wxyz, translation, where)


FileFormat(
    "aria",
    "Project Aria json",
    recognizes_keys=has_all("CameraCalibrations"),
    read_keys=read,
    ignored=r"DeviceClassInfo|\w+Calibrations|\w*Origin\w*|.*/(SerialNumber|Description|Confidence|Time\w*)",
).register()
