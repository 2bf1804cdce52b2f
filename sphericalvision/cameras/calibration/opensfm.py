# SPDX-License-Identifier: Apache-2.0
"""OpenSfM's and ODM's ``camera_models.json`` (``cameras.json``), and ``reconstruction.json`` with poses.

Convention:
    Lengths are shares of the longer side of the image, from its middle; the first pixel's centre is (0.5, 0.5).
    ``rotation`` (axis-angle) and ``translation`` of a shot take coordinates of the world to the camera's. Lengths are
    in the reconstruction's own unit, which is metres if it is georeferenced. Poses of rigs count before those of their
    shots.

References:
    https://opensfm.org/docs/geometry.html, "Camera models" and "Coordinate systems".
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.contents import Calibration
from sphericalvision.cameras.calibration.formats import FileFormat
from sphericalvision.cameras.calibration.keys import Keys
from sphericalvision.cameras.calibration.lenses import distorted
from sphericalvision.cameras.calibration.parsing import view_name
from sphericalvision.cameras.calibration.poses import transform_from_rotation_vector
from sphericalvision.cameras.models.equirectangular import EquirectangularCamera
from sphericalvision.core import FileFormatError, short_repr
from sphericalvision.geometry import invert_transform

_MODELS = {
    "perspective": ("radtan", "k1 k2 0 0"),
    "simple_radial": ("radtan", "k1 0 0 0"),
    "radial": ("radtan", "k1 k2 0 0"),
    "brown": ("radtan", "k1 k2 p1 p2 k3"),
    "fisheye": ("equidistant", "k1 k2 0 0"),
    "fisheye_opencv": ("equidistant", "k1 k2 k3 k4"),
}
_PANORAMAS = ("spherical", "equirectangular")


def recognizes(content: dict[str, Any]) -> bool:
    """Whether a parsed file has shots with cameras, or is cameras with a ``projection_type``."""
    return ("shots" in content and "cameras" in content) or any(
        isinstance(values, dict) and "projection_type" in values for values in content.values()
    )


def read(content: Keys, calibration: Calibration) -> None:
    """The lenses by name; or if poses are wanted, a camera for each shot."""
    lenses = content.inner("cameras") if "shots" in content else content
    wants_shots = calibration.options.rig and "shots" in content
    cameras = Calibration(calibration.options, calibration.path) if wants_shots else calibration
    for name in lenses:
        cameras.add(str(name), _camera(lenses.inner(name)), lenses.at(name))
    if not wants_shots:
        return
    shots, rigs = content.inner("shots"), _rig_poses(content)
    for file in shots:
        shot = shots.inner(file)
        lens, name = str(shot.entry("camera")), view_name(file)
        if lens not in cameras.cameras or not name:
            raise FileFormatError(
                f"{shot.where}: expected a name and a camera that is there, got {short_repr(lens)}"
            )
        if shot.get("orientation", 1) not in (0, 1):
            raise FileFormatError(f"{shot.at('orientation')}: expected 1, an image that is not turned")
        pose = invert_transform(rigs.get(file, _pose(shot)))
        calibration.add(name, cameras.cameras[lens], shot.where, pose)


def _rig_poses(content: Keys) -> dict[str, Tensor]:
    """Poses of the shots of rigs, by which OpenSfM goes: those of shots may be older."""
    instances = content.inner("rig_instances") if "rig_instances" in content else Keys()
    poses = {}
    for name in instances:
        rig_from_world = _pose(instances.inner(name))
        for file, camera in instances.inner(name).inner("rig_camera_ids").items():
            poses[file] = _pose(content.inner("rig_cameras").inner(str(camera))) @ rig_from_world
    content.read -= {"rig_cameras", "rig_instances"}  # of which the rest does not matter
    return poses


def _pose(values: Keys) -> Tensor:
    """(4, 4), from the world, or from the rig, to the camera."""
    rotation, translation = (values.numbers(key, 3) for key in ("rotation", "translation"))
    return transform_from_rotation_vector(rotation, translation, values.at("rotation"))


def _camera(values: Keys) -> Camera:
    kind = values.chosen("projection_type", (*_MODELS, *_PANORAMAS))
    size = values.size("width", "height")
    if kind in _PANORAMAS:
        return EquirectangularCamera(size)
    side = max(size)
    focal = ("focal_x", "focal_y") if "focal_x" in values or "focal" not in values else ("focal", "focal")
    fx, fy = (side * values.number(key) for key in focal)
    u, v = (side * values.number(key, 0.0) for key in ("c_x", "c_y"))
    lens, keys = _MODELS[kind]
    more = [0.0 if key == "0" else values.number(key) for key in keys.split()]
    plane = [fx, fy, size[1] / 2 - 0.5 + u, size[0] / 2 - 0.5 + v]
    return distorted(lens, [*plane, *more], size, values.where)


FileFormat(
    "opensfm",
    "OpenSfM and ODM cameras or reconstruction",
    recognizes_keys=recognizes,
    read_keys=read,
    usual_names=("reconstruction.json", "camera_models.json"),
    ignored=r"points|shots|biases|rig_\w+|reference_lla|reference|.*/\w+_prior|shots/.*/(gps_\w+|capture_time|vertices"
    r"|faces|scale|covariance|merge_cc|is_\w+|compass|skey|gravity_\w+)",
).register()
