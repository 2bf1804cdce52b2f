# SPDX-License-Identifier: Apache-2.0
"""Methods of ``Camera`` and ``CameraRig`` that are written in modules above them, which import both."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

__all__ = ["verb"]

_FUNCTIONS = {
    "Camera.convert": ("conversion.convert", "convert"),
    "CameraRig.sample_sphere": ("sphere_images", "sample_sphere"),
    "CameraRig.to_yaml": ("calibration.native", "write_rig"),
}
"""Module, within ``sphericalvision.cameras``, and name of the function behind each method."""


def verb(name: str) -> Callable[..., Any]:
    """The function behind a method, such as ``"Camera.convert"``; its module is imported now."""
    module, function = _FUNCTIONS[name]
    found: Callable[..., Any] = getattr(import_module(f"sphericalvision.cameras.{module}"), function)
    return found
