# SPDX-License-Identifier: Apache-2.0
"""Spherical vision for PyTorch: wide cameras, icospheres, crown convolutions and sphere sweeps."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphericalvision.capture import Predictor as Predictor

__version__ = "0.2.0"

_ROOMS = (
    "cameras",
    "capture",
    "core",
    "crown",
    "data",
    "deploy",
    "geometry",
    "icosphere",
    "io",
    "losses",
    "metrics",
    "models",
    "scenes",
    "sphere",
    "sweep",
    "viz",
)
"""Packages that are imported when they are first asked for: ``sphericalvision.cameras`` after a bare import."""


_NAMES = {"Predictor": "capture"}
"""Names that the package itself offers, and the room that each comes from."""


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return import_module(f"{__name__}.{name}")
    if name in _NAMES:
        return getattr(import_module(f"{__name__}.{_NAMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_ROOMS, *_NAMES])
