# SPDX-License-Identifier: Apache-2.0
"""Trained networks that ship with the package."""

from __future__ import annotations

from pathlib import Path

from sphericalvision.core import check_choice
from sphericalvision.models.base import DepthNetwork
from sphericalvision.models.weights.files import load_weights

__all__ = ["available_weights", "pretrained"]

_SHIPPED = Path(__file__).parent / "shipped"


def available_weights() -> tuple[str, ...]:
    """Return the names of the trained networks that ship with the package.

    Examples:
        >>> "refinedsweepnet" in available_weights()
        True
    """
    return tuple(sorted(path.stem for path in _SHIPPED.glob("*.safetensors")))


def pretrained(name: str = "refinedsweepnet") -> DepthNetwork:
    """Return a trained network that ships with the package, on the CPU and in eval mode.

    Its model card, ``shipped/<name>.md`` next to this file, tells how it was trained and how accurate it is.

    Raises:
        ArgumentError: if there is no network of this name.

    Examples:
        >>> pretrained("icosweepnet-small").level
        6
    """
    check_choice("name", name, available_weights())
    return load_weights(_SHIPPED / f"{name}.safetensors")
