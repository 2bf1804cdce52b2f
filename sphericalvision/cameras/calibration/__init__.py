# SPDX-License-Identifier: Apache-2.0
"""Calibration files, one module a format: readers that recognise them, and writers."""

from importlib import import_module
from typing import Any

from lazy_loader import attach_stub

_own, __dir__, __all__ = attach_stub(__name__, __file__)
__all__ += ["CAMERA_FORMATS", "RIG_FORMATS"]

_LISTS = {"CAMERA_FORMATS": "camera_formats", "RIG_FORMATS": "rig_formats"}
"""Names of the formats in which ``save_camera`` and ``save_rig`` write; asked for anew each time."""


def __getattr__(name: str) -> Any:
    if name in _LISTS:
        return getattr(import_module(f"{__name__}.save"), _LISTS[name])()
    return _own(name)
