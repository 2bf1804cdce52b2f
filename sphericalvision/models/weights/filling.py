# SPDX-License-Identifier: Apache-2.0
"""A network filled with weights from a file, after they have been looked at."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from sphericalvision.core import FileFormatError

__all__ = ["filled", "made"]

Network = TypeVar("Network", bound=nn.Module)

FACTORIES = (torch.empty, torch.zeros, torch.ones, torch.rand, torch.randn)
"""What weights are made with."""
SPARE = 10_000_000
"""Numbers, 40 MB, that a network may allocate beside the weights."""
SPARE_TENSORS = 1000
"""Tensors that it may make beside four for each weight."""


def made(
    network: Callable[..., Network],
    hyperparameters: Mapping[str, Any],
    state: Mapping[str, Tensor],
    source: str | Path,
) -> Network:
    """Return a network with the hyper-parameters and the weights of a file.

    Where the hyper-parameters ask for far more weights than there are, nothing of that is allocated: a damaged number
    could ask for any amount of memory, and for layers without end.

    Raises:
        FileFormatError: as ``filled`` does, and for far more tensors. Whatever ``network`` raises of hyper-parameters
            passes.
    """
    numbers, tensors = (
        sum(tensor.numel() for tensor in state.values()) + SPARE,
        4 * len(state) + SPARE_TENSORS,
    )
    try:
        with _AtMost(numbers, tensors):
            net = network(**hyperparameters)
    except _TooManyError as error:
        if error.tensors:
            raise FileFormatError(
                f"{source}: the hyper-parameters ask for more than {tensors} tensors, with weights for {len(state)}"
            ) from None
        _check_outline(network, hyperparameters, state, source)
        net = network(**hyperparameters)  # it is right: much of it is not weights
    return filled(net, state, source)


def _check_outline(
    network: Callable[..., nn.Module],
    hyperparameters: Mapping[str, Any],
    state: Mapping[str, Tensor],
    source: str | Path,
) -> None:
    """Check shapes without any numbers; not always, as for this torch imports all that it traces with: seconds."""
    try:
        with torch.device("meta"):
            outline = network(**hyperparameters)
    except (
        Exception
    ):  # a network that cannot be made without its numbers; made for real it says what is wrong
        return
    _check_fits(outline, state, source)


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


class _TooManyError(Exception):
    """A network asks for many more numbers than its file has, or for many more ``tensors``."""

    def __init__(self, tensors: bool) -> None:
        super().__init__()
        self.tensors = tensors


class _AtMost(TorchFunctionMode):
    """Within it, ``torch.empty`` and the like, of which weights are made, give so much in all, and no more."""

    def __init__(self, numbers: int, tensors: int) -> None:
        super().__init__()
        self.left, self.tensors_left = numbers, tensors

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in FACTORIES:
            size = (kwargs or {}).get("size", args)
            self.left -= torch.empty(*size, device="meta").numel()
            self.tensors_left -= 1
            if self.left < 0 or self.tensors_left < 0:
                raise _TooManyError(tensors=self.tensors_left < 0)
        return func(*args, **(kwargs or {}))


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
