# SPDX-License-Identifier: Apache-2.0
"""Camera models that work on directions, beyond 180° where the lens does, rigs of them, and calibration files."""

from importlib import import_module
from typing import Any

from lazy_loader import attach_stub

_own, __dir__, __all__ = attach_stub(__name__, __file__)

_MOVED = (
    "OwnBody",
    "PhotometricCalibration",
    "align_rig_direct",
    "calibrate_camera",
    "calibrate_photometry",
    "find_own_body",
    "refine",
    "refine_rig",
)
"""Names that are in ``sphericalvision.capture`` since, and may still be asked for here."""


def __getattr__(name: str) -> Any:
    return getattr(import_module("sphericalvision.capture"), name) if name in _MOVED else _own(name)
