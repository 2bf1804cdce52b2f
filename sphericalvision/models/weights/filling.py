# SPDX-License-Identifier: Apache-2.0
"""A network filled with weights from a file, after they have been looked at."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

from torch import Tensor

from sphericalvision.core import FileFormatError
from sphericalvision.models.base import DepthNetwork

__all__ = ["filled"]

Network = TypeVar("Network", bound=DepthNetwork)


def filled(net: Network, state: Mapping[str, Tensor], source: str | Path) -> Network:
    """Return ``net`` with the weights ``state``.

    Raises:
        FileFormatError: if weights are missing, unknown, of another shape or not finite; the message names the first
            ones and ``source``.
    """
    expected = net.state_dict()
    problems = [f"'{name}' is missing" for name in expected if name not in state]
    problems += [f"'{name}' is unknown" for name in state if name not in expected]
    problems += [
        f"'{name}' has shape {tuple(state[name].shape)}, expected {tuple(tensor.shape)}"
        for name, tensor in expected.items()
        if name in state and state[name].shape != tensor.shape
    ]
    if problems:
        raise FileFormatError(
            f"{source}: the weights do not fit {type(net).__name__} with {net.extra_repr()}: {_first(problems)}"
        )
    problems = [f"'{name}'" for name, tensor in state.items() if not tensor.isfinite().all()]
    if problems:
        raise FileFormatError(
            f"{source}: weights are infinite or not numbers, so the training they come from went wrong: "
            f"{_first(problems)}"
        )
    net.load_state_dict(dict(state))
    return net


def _first(problems: list[str]) -> str:
    more = f" and {len(problems) - 3} more" if len(problems) > 3 else ""
    return "; ".join(problems[:3]) + more
