# SPDX-License-Identifier: Apache-2.0
"""A network filled with weights from a file, after they have been looked at."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from sphericalvision.core import FileFormatError

__all__ = ["filled", "made"]

Network = TypeVar("Network", bound=nn.Module)


def made(
    network: Callable[..., Network],
    hyperparameters: Mapping[str, Any],
    state: Mapping[str, Tensor],
    source: str | Path,
) -> Network:
    """Return a network with the hyper-parameters and the weights of a file.

    Where the hyper-parameters ask for other weights than there are, nothing is allocated: a damaged number could ask
    for any amount of memory.

    Raises:
        FileFormatError: as ``filled`` does. Whatever ``network`` raises of hyper-parameters passes.
    """
    try:
        with torch.device("meta"):
            outline = network(**hyperparameters)
    except (
        Exception
    ):  # a network that cannot be made without its numbers; made for real it says what is wrong
        outline = None
    if outline is not None:
        _check_fits(outline, state, source)
    return filled(network(**hyperparameters), state, source)


def filled(net: Network, state: Mapping[str, Tensor], source: str | Path) -> Network:
    """Return ``net`` with the weights ``state``.

    Raises:
        FileFormatError: if weights are missing, unknown, of another shape or not finite; the message names the first
            ones and ``source``.
    """
    _check_fits(net, state, source)
    problems = [f"'{name}'" for name, tensor in state.items() if not tensor.isfinite().all()]
    if problems:
        raise FileFormatError(
            f"{source}: weights are infinite or not numbers, so the training they come from went wrong: "
            f"{_first(problems)}"
        )
    net.load_state_dict(dict(state))
    return net


def _check_fits(net: nn.Module, state: Mapping[str, Tensor], source: str | Path) -> None:
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


def _first(problems: list[str]) -> str:
    more = f" and {len(problems) - 3} more" if len(problems) > 3 else ""
    return "; ".join(problems[:3]) + more
