# SPDX-License-Identifier: Apache-2.0
"""A network filled with weights from a file, after its hyper-parameters and weights were checked."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

from torch import Tensor, nn

from sphericalvision.core import FileFormatError

Network = TypeVar("Network", bound=nn.Module)

BOUNDS = {"level": 10, "num_hypotheses": 1024, "num_cameras": 64, "output_size": 8192, "blocks": 32}
"""Largest whole numbers in hyper-parameters of a file, by name; ``bounds`` of a network's class come first."""
USUAL_BOUND = 512
"""Of all other hyper-parameters: widths, and numbers of layers and steps."""


def make_network(
    network: Callable[..., Network],
    hyperparameters: Mapping[str, Any],
    state: Mapping[str, Tensor],
    source: str | Path,
) -> Network:
    """Return a network with the hyper-parameters and the weights of a file.

    A damaged number could ask for any amount of memory, and for layers without end. So no constructor gets numbers
    beyond the bounds of its class.

    Raises:
        FileFormatError: as ``load_state`` does, and for hyper-parameters beyond their bounds. Whatever ``network``
            raises of hyper-parameters passes.
    """
    bounds = {**BOUNDS, **getattr(network, "bounds", {})}
    for name, number in _whole_numbers("", hyperparameters):
        bound = bounds.get(name, USUAL_BOUND)
        if abs(number) > bound:
            raise FileFormatError(
                f"{source}: hyper-parameter '{name}': expected at most {bound:,}, got {number:,}; the file is damaged, "
                "or raise the bound in the network's class (bounds)"
            )
    return load_state(network(**hyperparameters), state, source)


def _whole_numbers(name: str, value: Any) -> Iterator[tuple[str, int]]:
    """All whole numbers in a value of JSON, by the name that they stand under."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _whole_numbers(key, item)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _whole_numbers(name, item)
    elif isinstance(value, int) and not isinstance(value, bool):
        yield name, value


def load_state(net: Network, state: Mapping[str, Tensor], source: str | Path) -> Network:
    """Return ``net`` with the weights ``state``.

    Raises:
        FileFormatError: if weights are missing, unknown, of another shape or type, or not finite; the message names
            them and ``source``.
    """
    what = f"{source}: the weights do not fit {type(net).__name__} with {net.extra_repr()}"
    for name, tensor in net.state_dict().items():
        if name in state and state[name].is_floating_point() != tensor.is_floating_point():
            raise FileFormatError(f"{what}: '{name}' holds {state[name].dtype}, expected {tensor.dtype}")
    if infinite := [name for name, tensor in state.items() if not tensor.isfinite().all()]:
        raise FileFormatError(
            f"{source}: weights are infinite or not numbers, so the training they come from went wrong: "
            f"{', '.join(infinite[:3])} ({len(infinite)} in all)"
        )
    try:
        net.load_state_dict(dict(state), strict=True)
    except RuntimeError as error:  # torch lists what is missing, unknown or of another shape
        raise FileFormatError(f"{what}: {' '.join(str(error).split()):.1000}") from error
    return net
