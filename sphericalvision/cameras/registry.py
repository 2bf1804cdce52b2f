# SPDX-License-Identifier: Apache-2.0
"""Camera models by their names in files: the package's own, registered ones, and those of installed packages."""

from __future__ import annotations

import re
from typing import Any, TypeVar

from sphericalvision.cameras.base import Camera
from sphericalvision.core import ArgumentError
from sphericalvision.extensions import Registry

ENTRY_POINTS = "sphericalvision.cameras"
"""Group of entry points, name -> subclass of ``Camera``, in which other packages offer theirs."""

AnyModel = TypeVar("AnyModel", bound=type[Camera])


def _fits(name: str, model: Any) -> bool:
    return bool(name) and isinstance(model, type) and issubclass(model, Camera) and model.model == name


MODELS: Registry[type[Camera]] = Registry(
    "model",
    "a subclass of Camera whose `model` is its name in files",
    _fits,
    ENTRY_POINTS,
    folder="sphericalvision.cameras.models",
)


def register_camera(model: AnyModel) -> AnyModel:
    """Make a camera model known by its name, so that ``read_rig``, ``to_yaml`` and ``convert`` find it.

    A package that others install names its models as entry points of the group ``sphericalvision.cameras`` instead,
    and they are found without being imported.

    Args:
        model: a subclass of ``Camera`` whose ``model`` is its name; also as a decorator.

    Raises:
        ArgumentError: it has no name, or one that another model has.

    Examples:
        >>> from sphericalvision.cameras import PinholeCamera
        >>> @register_camera
        ... class Periscope(PinholeCamera):
        ...     model = "periscope"
        >>> camera_model("periscope").__name__
        'Periscope'
    """
    MODELS.add(getattr(model, "model", ""), model)
    return model


def camera_model(name: str) -> type[Camera] | None:
    """The camera model of a name, or None."""
    return MODELS.find(name)


def camera_model_names() -> tuple[str, ...]:
    """The names of all models, in alphabetical order."""
    return MODELS.names()


_SYNONYMS = [
    group.split()
    for group in (
        "none no pinhole perspective undistorted rectified nodistortion",
        "radtan radialtangential radialtangential4 plumbbob brownconrady brown radtan4 radtan5 opencv",
        "rationalpolynomial rational radtan8 radialtangential8 pinholeradtan8",
        "thinprism",
        "tilted",
        "equidistant equi kannalabrandt kannalabrandt4 kannalabrandt8 kb kb4 opencvfisheye fisheye",
        "fov atan",
        "omni omnidir mei unified ucm",
        "eucm extendedunified",
        "ds doublesphere",
    )
]
"""What lenses are called, in small letters alone; the first of a line stands for all of it."""


def model_meant(value: Any) -> str:
    """The name that stands for a model's name and all its synonyms; any other name stands for itself."""
    return _synonyms(value)[0]


def camera_model_meant(name: str) -> type[Camera] | None:
    """The camera model of a name, of another spelling or of a synonym of it, or None.

    Examples:
        >>> [camera_model_meant(name).__name__ for name in ("kb4", "Double Sphere", "fisheye")]
        ['KannalaBrandtCamera', 'DoubleSphereCamera', 'FisheyeCamera']
    """
    names = {_spelled(known): known for known in camera_model_names()}
    meant = next((names[word] for word in _synonyms(name) if word in names), name)
    return camera_model(name) or camera_model(meant)


def _synonyms(name: Any) -> list[str]:
    spelled = _spelled(name)
    return next((group for group in _SYNONYMS if spelled in group), [spelled])


def _spelled(name: Any) -> str:
    return re.sub(r"[^a-z0-9]", "", str(name).lower())


def check_registered(camera: Camera) -> None:
    """Raise ``ArgumentError`` unless the camera's class is found by its name."""
    registered = camera_model(camera.model)
    if registered is not type(camera):
        kind = type(camera).__name__
        problem = f"is {registered.__name__}'s name" if registered else "is not known"
        raise ArgumentError(
            f"camera: {kind} could not be read back: its model {camera.model!r} {problem}. Register the class with "
            f"sphericalvision.cameras.register_camera, or as an entry point of {ENTRY_POINTS!r}"
        )
