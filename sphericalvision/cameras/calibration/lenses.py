# SPDX-License-Identifier: Apache-2.0
"""The lenses of a file format: a table of its names, our classes and the order of numbers, read in both directions.

Numbers have the names that the intrinsics of a camera model declare: fx fy cx cy, k1 k2 p1 p2 and so on, or that of the
intrinsic itself, such as xi. In a table ``gamma=fx`` is a number that the file calls gamma. Of a unified camera
``alpha=xi`` is α = ξ / (1 + ξ), and the focal lengths are then f = γ / (1 + ξ).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Shaped
from torch import Tensor

from sphericalvision.cameras.base import Camera, check_single
from sphericalvision.cameras.calibration.formats import file_format, file_formats
from sphericalvision.cameras.calibration.parsing import chosen_model, errors_of_file, focal_lengths
from sphericalvision.cameras.declaration import Intrinsic
from sphericalvision.cameras.registry import camera_model
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.geometry.panorama import ALL_LATITUDES, ALL_LONGITUDES
from sphericalvision.io.files import refuse_folder


@dataclass(frozen=True)
class Lens:
    """A lens of a format.

    Attributes:
        name: as the format calls it.
        model: name of our class.
        numbers: their names, in the order of the file; ``f`` is fx and fy.
        zeros: names of numbers of our class that the format does not have, and that are read as 0. Numbers of an
            intrinsic that stand behind all named ones need not be there.
        options: of our class.
    """

    name: str
    model: str
    numbers: str
    zeros: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def _class(self) -> type[Camera]:
        model = camera_model(self.model)
        assert model is not None, self.model
        return model

    @cached_property
    def keys(self) -> tuple[str, ...]:
        """What the file calls the numbers."""
        return tuple(word.split("=")[0] for word in self.numbers.split())

    @cached_property
    def names(self) -> tuple[str, ...]:
        """What our class calls them."""
        return tuple(word.split("=")[-1] for word in self.numbers.split())

    @property
    def _has_alpha(self) -> bool:
        return self.model == "unified" and "alpha" in self.keys

    def camera(
        self,
        numbers: Sequence[float],
        image_size: tuple[int, int],
        where: str,
        max_angle: float | None = None,
        skew: float | None = None,
    ) -> Camera:
        """The camera of the numbers of a file, in its order; ``where`` names the place in errors."""
        if not self.names:
            return self._class(image_size=image_size, **self.options)
        if self.model == "atan" and numbers[self.names.index("omega")] == 0:  # which stands for no distortion
            return Lens(self.name, "pinhole", "fx fy cx cy").camera(numbers[:4], image_size, where, max_angle)
        parameters = dict.fromkeys(self.zeros.split(), 0.0) | dict(zip(self.names, numbers, strict=False))
        if self._has_alpha:
            if not 0 <= parameters["xi"] < 1:
                raise FileFormatError(
                    f"{where}, alpha: expected a number in [0, 1), got {parameters['xi']:g}"
                )
            parameters |= {name: parameters[name] / (1 - parameters["xi"]) for name in ("fx", "fy", "xi")}
        if skew is not None:
            parameters["skew"] = skew
        if "f" in parameters:
            parameters["fx"] = parameters["fy"] = parameters["f"]
        keys = [key for key, name in zip(self.keys, self.names, strict=True) if name in ("f", "fx", "fy")]
        focal_lengths([parameters["fx"], parameters["fy"]], f"{where}, {' and '.join(keys)}")
        intrinsics = {
            name: _tensor(name, declared, parameters)
            for name, declared in self._class.declared.items()
            if isinstance(declared, Intrinsic)
        }
        if max_angle is None and self._class.is_endless:
            max_angle = math.pi
        arguments: dict[str, Any] = {**intrinsics, **self.options, "max_angle": max_angle}
        with errors_of_file(where):
            return self._class(image_size=image_size, **arguments)

    def shifted(self, numbers: Sequence[float], by: float) -> list[float]:
        """The numbers with another principal point, for files that count from a pixel's corner."""
        pairs = zip(self.names, numbers, strict=True)
        return [value + by if name in ("cx", "cy") else value for name, value in pairs]

    def split(self, camera: Camera) -> tuple[list[float], dict[str, Any]]:
        """The numbers of a camera of our class in the order of the file, and what it has that the lens has not."""
        excess: dict[str, Any] = {
            name: getattr(camera, name)
            for name, value in self.options.items()
            if getattr(camera, name) != value
        }
        parameters: dict[str, float] = {}
        for name, declared in self._class.declared.items():
            if isinstance(declared, Intrinsic):
                value, names = getattr(camera, name), declared.names(name)
                if value is None and set(names) & set(self.names):
                    excess[name] = None
                numbers = [] if value is None else numbers_of(value)
                parameters |= zip(names, numbers * 2 if name == "focal_length" else numbers, strict=False)
        excess |= {name: value for name, value in parameters.items() if value and name not in self.names}
        if self._has_alpha:
            parameters |= {name: parameters[name] / (1 + parameters["xi"]) for name in ("fx", "fy", "xi")}
        return [parameters.get(name, 0.0) for name in self.names], excess


PANORAMA = Lens(
    "EQUIRECTANGULAR",
    "equirectangular",
    "",
    options={"latitudes": ALL_LATITUDES, "longitudes": ALL_LONGITUDES},
)
"""A whole one, which is known by its size."""


def _tensor(name: str, declared: Intrinsic, parameters: Mapping[str, float]) -> Tensor | None:
    """An intrinsic, in float64, of numbers by name."""
    names = declared.names(name)
    indices = [index for index, number in enumerate(names) if number in parameters]
    if not indices and declared.optional:
        return None
    if not declared.sizes:
        return torch.tensor(parameters[name], dtype=torch.float64)
    size = min(size for size in declared.sizes if size > max(indices, default=0))
    return torch.tensor([parameters.get(number, 0.0) for number in names[:size]], dtype=torch.float64)


_DISTORTED = (
    Lens("none", "pinhole", "fx fy cx cy"),
    Lens("radtan", "brown_conrady", "fx fy cx cy k1 k2 p1 p2"),
    Lens("radtan", "brown_conrady", "fx fy cx cy k1 k2 p1 p2 k3"),
    Lens("rational_polynomial", "brown_conrady", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    Lens("thin_prism", "brown_conrady", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4"),
    Lens("tilted", "brown_conrady", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 τx τy"),
    Lens("equidistant", "kannala_brandt", "fx fy cx cy k1 k2 k3 k4"),
    Lens("fov", "atan", "fx fy cx cy omega"),
    Lens("omni", "unified", "fx fy cx cy xi"),
    Lens("omni", "unified", "fx fy cx cy xi k1 k2 p1 p2", zeros="k3"),
    Lens("omni", "unified", "fx fy cx cy xi k1 k2 p1 p2 k3"),
)
"""What the field calls a camera matrix with these coefficients; ``model_meant`` knows other names for them."""


def distorted(
    kind: Any, numbers: Sequence[float], image_size: tuple[int, int], where: str, skew: float | None = None
) -> Camera:
    """The camera of fx fy cx cy and coefficients, by the name of their model in any of its spellings.

    Raises:
        FileFormatError: the name is not known, or the model has another number of coefficients.
    """
    kind = chosen_model(kind, dict.fromkeys(lens.name for lens in _DISTORTED), f"{where}, model of the lens")
    fitting = [lens for lens in _DISTORTED if lens.name == kind]
    most = max(len(lens.keys) for lens in fitting)
    if not any(numbers[most:]):  # the T265 has a fifth coefficient of 0, which its model has not
        numbers = numbers[:most]
    for lens in fitting:
        if len(lens.keys) == len(numbers):
            return lens.camera(numbers, image_size, where, skew=skew)
    counts = " or ".join(str(len(lens.keys) - 4) for lens in fitting)
    raise FileFormatError(
        f"{where}: expected {counts} coefficients of the model {kind}, got {len(numbers) - 4}"
    )


def lens_called(lenses: Iterable[Lens], name: str) -> Lens:
    """The lens of a name that is known."""
    return next(lens for lens in lenses if lens.name == name)


def models_of(lenses: Iterable[Lens]) -> tuple[str, ...]:
    """Names of our models in a table."""
    return tuple(dict.fromkeys(lens.model for lens in lenses))


def lens_of(camera: Camera, lenses: Sequence[Lens], format: str) -> tuple[Lens, list[float]]:
    """The first lens of a table that holds a camera, and its numbers."""
    check_holds(format, camera)
    candidates = [(lens, *lens.split(camera)) for lens in lenses if lens.model == camera.model]
    lens, numbers, beyond = min(candidates, key=lambda entry: len(entry[2]))  # the first of equals
    if beyond:
        raise ArgumentError(
            f"camera: of {camera.model} the format {format!r} holds "
            + " ".join([*lens.names, *(f"with {name}={value!r}" for name, value in lens.options.items())])
            + f", and this one has {', '.join(f'{name}={value!r}' for name, value in beyond.items())}; write it as "
            "'native', or convert the camera first: convert(camera, to=...)"
        )
    return lens, numbers


def check_holds(format: str, camera: Camera) -> None:
    """Raise ``ArgumentError`` unless ``format`` has the camera's model and the camera is no batch."""
    check_single(camera)
    models = file_format(format).models
    if models and camera.model not in models:
        others = [
            other.name
            for other in file_formats()
            if (other.write_camera or other.write_rig) and (not other.models or camera.model in other.models)
        ]
        raise ArgumentError(
            f"camera: the format {format!r} has no {camera.model} model, it has {', '.join(models)}. Write it as "
            f"{' or '.join(map(repr, others))}, or convert the camera first: convert(camera, to=...)"
        )
    formats = [other.name for other in file_formats() if camera.model in other.models_with_skew]
    if format not in formats and getattr(camera, "skew", None) is not None:
        raise ArgumentError(
            f"camera: the format {format!r} has no skew; write it as {' or '.join(map(repr, formats))}, or convert "
            'the camera to OCam, whose affine map holds one: convert(camera, to="ocam")'
        )


def check_targets(path: Path, masks: Mapping[str, Path], rig: CameraRig) -> None:
    """Raise ``ArgumentError`` if a file cannot be written, or is taken for the mask of a camera that has none."""
    refuse_folder(path)
    for name, mask in masks.items():
        if name not in rig.masks and mask.is_file():
            raise ArgumentError(
                f"path: {mask} would be taken for the mask of {name}, which has none; remove it, or write elsewhere"
            )


def numbers_of(tensor: Shaped[Tensor, " ..."]) -> list[float]:
    """Plain float64 numbers of a parameter, whatever its device and whether it is learned."""
    values: list[float] = tensor.detach().to("cpu").double().flatten().tolist()
    return values


def as_rig(cameras: Camera | CameraRig) -> CameraRig:
    """A rig, or the rig of one camera in the middle of the world."""
    return cameras if isinstance(cameras, CameraRig) else CameraRig({"cam1": cameras}, torch.eye(4)[None])
