# SPDX-License-Identifier: Apache-2.0
"""Trained networks that ship with the package."""

from __future__ import annotations

from pathlib import Path

from sphericalvision.core import MissingFileError, check_choice
from sphericalvision.models.depth_network import DepthNetwork
from sphericalvision.models.weights.files import load_weights

_HERE = Path(__file__).parent
_SHIPPED = _HERE / "shipped"

DEFAULT = "refinedsweepnet"
"""Weights that are taken where none are named."""
STUDY = ("icosweepnet-study", "omnimvs-study")
"""Networks that only the study and the depth benchmark compare with: in the folder ``study`` of the source tree, and
not in an installed package, of which they were a quarter."""


def available_weights() -> tuple[str, ...]:
    """Return the names of the trained networks that ship with the package.

    Examples:
        >>> "refinedsweepnet" in available_weights()
        True
    """
    return tuple(sorted(path.stem for path in _SHIPPED.glob("*.safetensors")))


def pretrained(name: str = DEFAULT) -> DepthNetwork:
    """Return a trained network that ships with the package, on the CPU and in eval mode.

    Its model card, ``shipped/<name>.md`` next to this file, tells how it was trained and how accurate it is.

    Args:
        name: one of ``available_weights()``; in a source tree also ``"icosweepnet-study"`` or ``"omnimvs-study"``,
            whose cards are in ``study/``.

    Raises:
        ArgumentError: if there is no network of this name.
        MissingFileError: if it is one of the study's, and this is no source tree.

    Examples:
        >>> pretrained("icosweepnet-small").level
        6
    """
    if name not in STUDY:
        check_choice("name", name, available_weights())
        return load_weights(_SHIPPED / f"{name}.safetensors")
    path = _HERE / "study" / f"{name}.safetensors"
    if not path.exists():
        raise MissingFileError(
            f"name: {name!r} is for the study and the depth benchmark, and not in the installed package; run them in "
            "a checkout of the repository (pip install -e .), which has it as "
            f"sphericalvision/models/weights/study/{path.name}"
        )
    return load_weights(path)
