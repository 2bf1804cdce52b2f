# SPDX-License-Identifier: Apache-2.0
"""Options of a calibration reader, and the cameras, poses and masks that it returns."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.calibration.parsing import (
    FARTHEST,
    METRES_PER_UNIT,
    check_radius,
    errors_of_file,
)
from sphericalvision.cameras.calibration.visible_part import bounded
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import ArgumentError, FileFormatError, check_choice, short_repr

SHORTEST, LONGEST = 0.02, 100.0
"""Focal lengths in longer sides of the image: a lens of 280° has 0.2, a telescope 50."""
LEAST_SQUARE = 3.0
"""How many times longer than the other a focal length may be: anamorphic lenses have 2."""
SQUARE = 1.1
"""The same of pixels that are nearly square."""
MOST_STRETCHED = 1.5
"""How many times farther from the middle than a lens without distortion one may show a border."""
NEAR_AXIS = 1e-4
"""Tangent of the angle from the axis at which focal lengths are measured."""
LEAST_REACH = 0.05
"""Longer sides of the image from the axis, to which a model must hold: the smallest image circles reach 0.2."""


@dataclass(frozen=True)
class Options:
    """What a caller knows that a file may not tell; each is described where a user meets it, in ``read_rig``."""

    max_angle: float | None = None
    dtype: torch.dtype | None = None
    translation_unit: str | None = None
    image_size: tuple[int, int] | None = None
    rig: bool = False
    """Whether poses are wanted, where a file has fewer cameras than images with poses."""

    def given_size(self, where: str, keys: str = "it") -> tuple[int, int]:
        """The size of the images, of which the file at ``where`` does not tell ``keys``."""
        if self.image_size is None:
            raise ArgumentError(f"image_size: {where} does not tell {keys}; pass image_size=(height, width)")
        return self.image_size

    def metres(self, where: str, keys: str, stated: Any = None) -> float:
        """Metres in the unit of ``keys`` of the file at ``where``: what it states itself, or what the caller says."""
        unit = stated or self.translation_unit
        if self.rig and self.translation_unit not in (None, unit):
            raise ArgumentError(
                f"translation_unit: {where} says {unit!r:.80} itself, got {self.translation_unit!r}; leave it out"
            )
        if unit is None:
            raise ArgumentError(
                f"translation_unit: {where} does not tell the unit of {keys}; pass 'm', 'cm' or 'mm'"
            )
        with errors_of_file(where) if stated else nullcontext():
            check_choice("translation_unit", unit, tuple(METRES_PER_UNIT))
        return METRES_PER_UNIT[unit]


class Calibration:
    """Cameras of a file in its order, and poses and masks if it has any; readers add one after the other.

    Args:
        options: of the reader.
        path: of the file.

    Attributes:
        poses: ``(4, 4)``, float64, metres, to the world: one of each camera, or they are left out.
    """

    def __init__(self, options: Options, path: Path) -> None:
        self.options, self.path = options, path
        self.cameras: dict[str, Camera] = {}
        self.poses: list[Tensor] = []
        self.masks: dict[str, Tensor] = {}
        self._lenses: dict[int, tuple[Camera, Camera]] = {}

    @property
    def world_from_camera(self) -> Float[Tensor, "n 4 4"] | None:
        """The poses, if each camera has one."""
        return torch.stack(self.poses) if 0 < len(self.poses) == len(self.cameras) else None

    def add(
        self,
        name: str,
        camera: Camera,
        where: str,
        pose: Float[Tensor, "4 4"] | None = None,
        max_angle: float | None = None,
        mask: Bool[Tensor, "h w"] | None = None,
    ) -> None:
        """Add a camera.

        Args:
            name: a name of its own.
            camera: as wide as its model.
            where: its place in the file, in errors.
            pose: to the world.
            max_angle: half the field of view that the file tells; what the caller says counts before it, and without
                either the camera sees what its image shows.
            mask: that shows how far the camera sees.

        Raises:
            FileFormatError: there is a camera of this name, or it sees nothing.
        """
        if name in self.cameras:
            raise FileFormatError(f"{where}: a second camera named {short_repr(name)}; give it another name")
        limit = max_angle if self.options.max_angle is None else self.options.max_angle
        if id(camera) not in self._lenses:  # of which there may be many views
            self._lenses[id(camera)] = camera, bounded(camera, limit, where, mask)
        self.cameras[name] = self._lenses[id(camera)][1]
        if pose is not None:
            self.poses.append(pose)
        if mask is not None:
            self.masks[name] = mask

    def check(self) -> None:
        """Warn of numbers that would make sense in another unit or for another size of image.

        Raises:
            FileFormatError: there is no camera, or a position is farther away than any place on Earth.
        """
        if not self.cameras:
            raise FileFormatError(f"{self.path}: no camera in it")
        if any(bool((pose[:3, 3].abs() > FARTHEST).any()) for pose in self.poses):
            raise FileFormatError(
                f"{self.path}: a camera is more than {FARTHEST:g} m from the origin; expected metres"
            )
        lenses: dict[int, tuple[str, Camera]] = {}
        for name, camera in self.cameras.items():
            lenses.setdefault(id(camera), (name, camera))  # of which there may be many views
        for name, camera in lenses.values():
            if doubts := _doubts(camera):  # of which the first camera's are probably those of all
                for doubt in doubts:
                    warnings.warn(f"{self.path}, {name:.80}: {doubt}", stacklevel=5)
                break

    def is_like(self, other: Calibration) -> bool:
        """Whether the cameras and poses are the same but for rounding."""

        def near(first: Tensor | None, second: Tensor | None) -> bool:
            if first is None or second is None:
                return first is second
            return first.shape == second.shape and torch.allclose(first, second, rtol=1e-5, atol=1e-6)

        def relative(poses: Tensor | None) -> Tensor | None:  # in a far world all positions would be near
            return None if poses is None else poses[:, :3, 3] - poses[:1, :3, 3]

        return (
            list(self.cameras) == list(other.cameras)
            and near(self.world_from_camera, other.world_from_camera)
            and near(relative(self.world_from_camera), relative(other.world_from_camera))
            and all(
                type(camera) is type(twin)
                and camera.image_size == twin.image_size
                and all(near(getattr(camera, key), getattr(twin, key)) for key in camera.intrinsic_names)
                for camera, twin in zip(self.cameras.values(), other.cameras.values(), strict=True)
            )
        )

    def cast(self, dtype: torch.dtype | None) -> dict[str, Camera]:
        """The cameras with intrinsics of ``dtype``, by default torch's default."""
        target = dtype or torch.get_default_dtype()
        return {name: camera.to(target) for name, camera in self.cameras.items()}

    def rig(self, dtype: torch.dtype | None) -> CameraRig:
        """The rig, which must have poses.

        Raises:
            FileFormatError: the file has none, or one is no rigid transform.
        """
        if self.world_from_camera is None:
            several = f"{len(self.cameras)} cameras" if len(self.cameras) > 1 else "one camera"
            hint = "read_cameras" if len(self.cameras) > 1 else "read_camera"
            raise FileFormatError(
                f"{self.path}: holds {several} without poses, which makes no rig: use {hint}, and build a CameraRig "
                "with poses of your own"
            )
        with errors_of_file(str(self.path)):
            rig = CameraRig(self.cameras, self.world_from_camera, dict(self.masks))
            return check_radius(rig.to(dtype=dtype or torch.get_default_dtype()), self.path)


def _doubts(camera: Camera) -> list[str]:
    """What is implausible of a camera, a sentence each."""
    sentences, (height, width) = [], camera.image_size
    longest = max(height, width)
    # What a pixel is wide at the axis, whatever the model calls its focal length and its affine part.
    rays = torch.tensor([[0.0, 0.0, 1.0], [NEAR_AXIS, 0.0, 1.0], [0.0, NEAR_AXIS, 1.0]], dtype=torch.float64)
    pixels, valid = camera.project(rays)
    center = getattr(camera, "principal_point", None)
    low = high = 1.0
    if bool(valid.all()):
        lengths = (pixels[1:] - pixels[0]).norm(dim=-1) / NEAR_AXIS
        low, high = float(lengths.min()), float(lengths.max())
        border = torch.stack((pixels.new_tensor(width - 1.0), pixels[0, 1]))
        (x, _, z), seen = camera.unproject(border)
        stretch = float((border[0] - pixels[0, 0]) / lengths[0] * z / x)  # tensors divide by lengths of 0
        if low <= SHORTEST * longest or high >= LONGEST * longest or high > LEAST_SQUARE * low:
            sentences.append(
                f"the focal length {low:.4g} to {high:.4g} is implausible for an image of {width} x {height} (width x "
                "height); are these millimetres, or fractions of the image? Expected pixels, about as many in x as in y"
            )
        elif float(camera.max_angle) * high < LEAST_REACH * longest:
            sentences.append(
                f"its model ends {math.degrees(camera.max_angle):.2g}° from the axis, far inside the image; are the "
                "coefficients of the distortion those of another model, or of another unit?"
            )
        elif bool(seen) and stretch > MOST_STRETCHED:
            sentences.append(
                f"its model stretches the border of the image {stretch:.2g} times; are the coefficients of the "
                "distortion those of another model?"
            )
    if center is not None:
        u, v = center.tolist()
        off, turned = (max(abs(u / w - 0.5), abs(v / h - 0.5)) for w, h in ((width, height), (height, width)))
        if off > 0.24 or off > 0.08 > 4 * turned or (off > 0.08 and high > SQUARE * low):
            exchanged = ", or are width and height exchanged" if turned < off else ""
            sentences.append(
                f"the principal point ({u:.1f}, {v:.1f}) is far from the middle of its image, {width} x {height} "
                f"(width x height); is the calibration for another size{exchanged}, or are numbers exchanged?"
            )
    return sentences


def warn_left_out(path: Path, reason: str, names: Sequence[str]) -> None:
    """Warn of what is left out, if anything is."""
    if names:
        names = [f"{name:.80}" for name in names]
        first = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
        warnings.warn(f"{path}: {len(names)} left out, {reason}: {first}", stacklevel=5)


def joined(path: Path, parts: Sequence[Calibration]) -> Calibration:
    """One rig from the files of several cameras in a folder.

    Raises:
        FileFormatError: two files have a camera of one name, or one has no pose.
    """
    rig = Calibration(Options(), path)
    source: dict[str, str] = {}
    for part in parts:
        for name, camera in part.cameras.items():
            if name in rig.cameras:
                raise FileFormatError(
                    f"{part.path}: a second camera named {short_repr(name)} (the first is in {source[name]}); a rig "
                    "has one file for each camera: copy those into a folder of their own"
                )
            if part.world_from_camera is None:
                raise FileFormatError(
                    f"{part.path}: no pose of this camera; a rig needs one for every camera"
                )
            rig.cameras[name], source[name] = camera, part.path.name
        rig.poses += part.poses
    return rig
