# SPDX-License-Identifier: Apache-2.0
"""A network filled with weights from a file, after they have been looked at."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from sphericalvision.core import FileFormatError

__all__ = ["load_state", "make_network"]

Network = TypeVar("Network", bound=nn.Module)

USUAL = 128
"""A width, or a number of layers, that costs no more than tens of megabytes where the weights do not have it."""
LARGEST = 5_000
"""Sum of all whole numbers in the hyper-parameters of a network: hypotheses, widths, pixels, layers."""


def make_network(
    network: Callable[..., Network],
    hyperparameters: Mapping[str, Any],
    state: Mapping[str, Tensor],
    source: str | Path,
) -> Network:
    """Return a network with the hyper-parameters and the weights of a file.

    A damaged number could ask for any amount of memory, and for layers without end. So no constructor gets numbers
    beyond ``LARGEST``, and where one is larger than any that the weights show, the network is made without its
    numbers first, to compare shapes.

    Raises:
        FileFormatError: as ``load_state`` does, and for hyper-parameters that are too large. Whatever ``network``
            raises of hyper-parameters passes.
    """
    sizes = [abs(size) for size in _whole_numbers(hyperparameters)]
    if sum(sizes) > LARGEST:
        raise FileFormatError(
            f"{source}: the hyper-parameters ask for more than {LARGEST:,} hypotheses, channels, pixels and layers in "
            f"all: {dict(hyperparameters)!s:.500}; the file is damaged, or write a smaller network"
        )
    # A width is the length of some weight, and there are no more layers than weights.
    shown = max((size for tensor in state.values() for size in tensor.shape), default=0)
    if max(sizes, default=0) > max(shown, len(state), USUAL):
        _check_outline(network, hyperparameters, state, source)
    return load_state(network(**hyperparameters), state, source)


def _whole_numbers(value: Any) -> Iterator[int]:
    """All whole numbers in a value of JSON."""
    if isinstance(value, int) and not isinstance(value, bool):
        yield value
    elif isinstance(value, Mapping):
        yield from _whole_numbers(list(value.values()))
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _whole_numbers(item)


def _check_outline(
    network: Callable[..., nn.Module],
    hyperparameters: Mapping[str, Any],
    state: Mapping[str, Tensor],
    source: str | Path,
) -> None:
    """Check shapes without any numbers; not always, as for this torch imports all that it traces with: a second."""
    try:
        with torch.device("meta"):
            outline = network(**hyperparameters)
    except (
        Exception
    ):  # a network that cannot be made without its numbers; made for real it says what is wrong
        return
    _check_fits(outline, state, source)


def load_state(net: Network, state: Mapping[str, Tensor], source: str | Path) -> Network:
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
    problems += [
        f"'{name}' holds {state[name].dtype}, expected {tensor.dtype}"
        for name, tensor in expected.items()
        if name in state and state[name].is_floating_point() != tensor.is_floating_point()
    ]
    if problems:
        raise FileFormatError(
            f"{source}: the weights do not fit {type(net).__name__} with {net.extra_repr()}: {_first(problems)}"
        )


def _first(problems: list[str]) -> str:
    more = f" and {len(problems) - 3} more" if len(problems) > 3 else ""
    return "; ".join(problems[:3]) + more
