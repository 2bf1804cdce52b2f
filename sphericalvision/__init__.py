# SPDX-License-Identifier: Apache-2.0
"""Spherical vision for PyTorch: wide cameras, icospheres, crown convolutions and sphere sweeps."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

__version__ = "0.1.0"

_ROOMS = (
    "cameras",
    "core",
    "crown",
    "data",
    "geometry",
    "icosphere",
    "io",
    "losses",
    "metrics",
    "models",
    "sphere",
    "sweep",
    "viz",
)
"""Packages that are imported when they are first asked for: ``sphericalvision.cameras`` after a bare import."""


def __getattr__(name: str) -> ModuleType:
    if name in _ROOMS:
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_ROOMS])
