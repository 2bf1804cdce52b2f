# SPDX-License-Identifier: Apache-2.0
"""Rigs as configs describe them: angles in degrees, files by name."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal, TypeVar

import torch
from pydantic.dataclasses import dataclass

from sphericalvision.cameras import (
    Camera,
    CameraRig,
    EquirectangularCamera,
    FisheyeCamera,
    read_cameras,
    read_rig,
    ring_rig,
)
from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.recipes.app.kinds import STRICT, Count, FullAngle, HalfAngle, Positive, Size, Text, Unit

T = TypeVar("T")


def make_ring(
    num_cameras: Count = 4,
    radius: Positive = 0.2,
    image_size: Size = (320, 320),
    field_of_view_deg: FullAngle = 220.0,
    projection: Literal["equidistant", "equisolid", "stereographic", "orthographic"] = "equidistant",
) -> CameraRig:
    """A ring of fisheyes that look outwards; see ``sphericalvision.cameras.ring_rig``.

    Examples:
        >>> make_ring(3, radius=0.1)
        CameraRig(cam1, cam2, cam3: 3 x FisheyeCamera, radius 0.100 m)
    """
    return ring_rig(num_cameras, radius, image_size, math.radians(field_of_view_deg), projection)


def make_panorama_ring(
    num_cameras: Count = 4,
    radius: float = 0.2,
    image_size: Size = (256, 512),
) -> CameraRig:
    """Cameras that see all around, in the poses of ``make_ring``: their images are equirectangular panoramas.

    Examples:
        >>> make_panorama_ring(2, radius=0.1)
        CameraRig(cam1, cam2: 2 x EquirectangularCamera, radius 0.100 m)
    """
    camera = EquirectangularCamera(image_size)
    return CameraRig([camera] * num_cameras, ring_rig(num_cameras, radius).world_from_camera)


def make_corner_rig(
    width: Positive = 0.44,
    length: Positive = 0.6,
    image_size: Size = (320, 320),
    field_of_view_deg: FullAngle = 185.0,
    tilt_deg: float = 40.0,
) -> CameraRig:
    """Four fisheyes at the corners of a vehicle that look outwards along its diagonals and down.

    Args:
        width: of the rectangle of the cameras, metres.
        length: of the rectangle, metres; forward is along it.
        image_size: height, width in pixels.
        field_of_view_deg: full angle of each fisheye.
        tilt_deg: by which they look below the horizon.

    References:
        Komatsu et al. (2020), section IV-D: the authors' own rig, on an unmanned ground vehicle.

    Examples:
        >>> rig = make_corner_rig()
        >>> rig.positions[0].tolist()  # the camera in front, to the right
        [0.2199999988079071, 0.0, 0.30000001192092896]
        >>> rig.axes[0]  # looks to the right, down and forward
        tensor([0.5417, 0.6428, 0.5417])
    """
    lens = FisheyeCamera.from_field_of_view(image_size, math.radians(field_of_view_deg))
    corners = [(1, 1, 45.0), (1, -1, 135.0), (-1, -1, 225.0), (-1, 1, 315.0)]
    poses = [
        transform_from_axis_angle(
            torch.tensor([0.0, math.radians(yaw), 0.0]),
            torch.tensor([x * width / 2, 0.0, z * length / 2]),
        )
        for x, z, yaw in corners
    ]
    names = ("front_right", "back_right", "back_left", "front_left")
    rig = CameraRig(dict.fromkeys(names, lens), torch.stack(poses))
    return rig.rotated(tilt=math.radians(tilt_deg))


@dataclass(frozen=True, config=STRICT)
class Calibration:
    """A calibration file, and what it may not say itself.

    Attributes:
        calibration: file of any known format, or folder with ``ocam*.txt`` and ``poses.txt``.
        translation_unit: of ``poses.txt``: "m", "cm" or "mm".
        max_angle_deg: half the field of view in degrees, where the file does not say it.
        image_size: height, width in pixels, where the file does not say it.
    """

    calibration: Text
    translation_unit: Unit | None = None
    max_angle_deg: HalfAngle | None = None
    image_size: Size | None = None

    def rig(self, dtype: torch.dtype | None = None) -> CameraRig:
        """The rig of the file, with intrinsics and poses of a type, by default torch's default."""
        return self._read(read_rig, dtype, translation_unit=self.translation_unit)

    def camera_models(self, dtype: torch.dtype | None = None) -> dict[str, Camera]:
        """The cameras of the file by name, poses or not."""
        return self._read(read_cameras, dtype)

    def _read(self, read: Callable[..., T], dtype: torch.dtype | None, **keys: Any) -> T:
        angle = None if self.max_angle_deg is None else math.radians(self.max_angle_deg)
        with keys_named(path="calibration", max_angle="max_angle_deg"):
            return read(self.calibration, max_angle=angle, image_size=self.image_size, dtype=dtype, **keys)

    def cameras_and_rig(
        self, dtype: torch.dtype | None = None
    ) -> tuple[Mapping[str, Camera], CameraRig | None]:
        """The cameras of the file by name, and its rig; None if it has no poses.

        Raises:
            FileFormatError: the file holds neither.
        """
        try:
            rig = self.rig(dtype)
        except FileFormatError as no_rig:
            try:
                return self.camera_models(dtype), None
            except FileFormatError:
                raise no_rig from None
        return rig.cameras, rig


def rig_from_file(
    path: Text,
    translation_unit: Unit | None = None,
    max_angle_deg: HalfAngle | None = None,
    image_size: Size | None = None,
) -> CameraRig:
    """A rig from a calibration file of any format that ``read_rig`` knows; see ``Calibration``."""
    return Calibration(path, translation_unit, max_angle_deg, image_size).rig()


@contextmanager
def keys_named(**keys: str) -> Iterator[None]:
    """Tell errors of an argument by the key that it comes from.

    Examples:
        >>> with keys_named(path="calibration"):
        ...     raise ArgumentError("path: two files are there")
        Traceback (most recent call last):
        ...
        sphericalvision.core.ArgumentError: calibration: two files are there
    """
    try:
        yield
    except ArgumentError as error:
        argument, colon, rest = str(error).partition(": ")
        if colon and argument in keys:
            raise ArgumentError(f"{keys[argument]}: {rest}") from error
        if argument == "image_size":
            raise ArgumentError(str(error).replace("(height, width)", "[height,width]")) from error
        raise


def names_of(cameras: Sequence[str | int], rig: CameraRig) -> list[str]:
    """Names of cameras of a rig as a configuration has them, where ``1`` is a number; no place in their order.

    Raises:
        ArgumentError: the rig has no such camera.

    Examples:
        >>> names_of(["cam2"], make_ring(2))
        ['cam2']
    """
    names = [str(name) for name in cameras]
    if unknown := [name for name in names if name not in rig.cameras]:
        raise ArgumentError(f"cameras: expected names among {', '.join(rig.names)}, got {unknown[0]}")
    return names
