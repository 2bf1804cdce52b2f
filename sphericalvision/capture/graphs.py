# SPDX-License-Identifier: Apache-2.0
"""CUDA graphs: a function whose operations are recorded once and then started together, without waiting for Python."""

from __future__ import annotations

import threading
import warnings
import weakref
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils import _pytree
from torch.utils._python_dispatch import TorchDispatchMode

MOST_GRAPHS = 4
"""Of a function: each holds the memory of its inputs and results."""
_turns = threading.RLock()
"""One replay at a time: all graphs of a device share their memory."""
_latest: weakref.WeakValueDictionary[torch.device, torch.cuda.CUDAGraph] = weakref.WeakValueDictionary()
"""The graph of each device that was captured last: the next one shares its memory, if it is still there."""
_idle: dict[torch.device, Any] = {}
"""Events: the device has done with the results of the last replay, whichever graph and stream it was of."""


class _Graph(NamedTuple):
    inputs: tuple[Tensor, ...]
    replay: Callable[[], Any]
    outputs: Any
    idle: Any


class NoWaiting(TorchDispatchMode):
    """Refuses operations that a device has to be waited for, and copies between it and the host.

    Raises:
        RuntimeError: the first of them, by name.
    """

    WAITS = ("nonzero", "_local_scalar_dense", "masked_select", "_unique", "unique_", "equal", "is_nonzero")

    def __torch_dispatch__(
        self, function: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        """Call the operation, unless it is refused."""
        name = function.overloadpacket.__name__
        if name.startswith(self.WAITS) or _by_mask(name, args):
            raise RuntimeError(f"{name} reads a value back from the device")
        result = function(*args, **(kwargs or {}))
        if _between_devices(name, args, result):
            raise RuntimeError(f"{name} copies a tensor between the device and the host")
        return result


def _by_mask(name: str, args: tuple[Any, ...]) -> bool:
    """Whether entries are chosen by a mask, whose number is not known."""
    ids = args[1] if name.startswith("index") and len(args) > 1 and isinstance(args[1], list | tuple) else ()
    return any(isinstance(part, Tensor) and part.dtype == torch.bool for part in ids)


def _between_devices(name: str, args: tuple[Any, ...], result: Any) -> bool:
    """Whether values are copied from one device to another."""
    if name not in ("copy_", "_to_copy") or not isinstance(result, Tensor):
        return False
    source = args[1] if name == "copy_" else args[0]
    return bool(source.device != result.device)


class GraphedFunction:
    """A function of tensors on a CUDA device, captured as a graph at the second call with inputs of some shapes.

    The first makes what is made once, and what is called once, as for a window of a camera that moves, needs no graph.
    Inputs are copied to where the graph reads them, and results are copied from where it leaves them, so that calls
    from several threads get results of their own. The function must not read values back from the device.

    Args:
        name: of what is computed, for the warning.
        function: of tensors and of keyword arguments that can be hashed; returns tensors in nested tuples.
        otherwise: called in its place where it cannot be captured, which one warning tells; by default the function.
    """

    def __init__(
        self, name: str, function: Callable[..., Any], otherwise: Callable[..., Any] | None = None
    ) -> None:
        self.name, self.function, self.otherwise = name, function, otherwise or function
        self._called: set[Any] = set()
        self._graphs: dict[Any, _Graph | None] = {}

    def __call__(self, *inputs: Tensor, **options: Any) -> Any:
        """Return what the function returns."""
        kinds = tuple((tuple(value.shape), value.dtype, value.device) for value in inputs)
        key = kinds, tuple(options.items())
        with _turns:
            if key not in self._called:
                self._called.add(key)
                return self.function(*inputs, **options)
            if key not in self._graphs:
                self._graphs[key] = self._captured(inputs, options)
            graph = self._graphs[key]
            if graph is not None:
                return replayed(graph, inputs)
        return self.otherwise(*inputs, **options)

    def _captured(self, inputs: tuple[Tensor, ...], options: dict[str, Any]) -> _Graph | None:
        if sum(graph is not None for graph in self._graphs.values()) >= MOST_GRAPHS:
            self._warn(f"there are {MOST_GRAPHS} graphs of other shapes already")
            return None
        try:
            return captured(self.function, inputs, options)
        except torch.OutOfMemoryError:
            raise
        except (
            RuntimeError
        ) as error:  # of whatever cannot be recorded; ending the capture may fail for it, too
            _latest.pop(inputs[0].device, None)  # its memory may be left in the middle of the capture
            self._warn(str(error.__context__ or error).strip().partition("\n")[0])
            return None

    def _warn(self, reason: str) -> None:
        warnings.warn(f"device: {self.name} is computed without a CUDA graph, because {reason}", stacklevel=5)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_called": set(), "_graphs": {}}  # graphs stay where they were captured


def captured(function: Callable[..., Any], inputs: tuple[Tensor, ...], options: dict[str, Any]) -> _Graph:
    """Capture a function for inputs of such shapes.

    Raises:
        RuntimeError: it does what a graph cannot hold, such as reading a value back.
    """
    device = inputs[0].device
    with torch.cuda.device(device):
        static = tuple(value.clone() for value in inputs)
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        # What libraries ask of the device for a new stream must not be recorded. And a capture that fails leaves the
        # memory of torch in disorder: what would make it fail is looked for before.
        with torch.cuda.stream(stream), NoWaiting():
            function(*static, **options)
        torch.cuda.current_stream().wait_stream(stream)
        earlier = _latest.get(device)  # memory of graphs that are all gone cannot be taken again
        pool = None if earlier is None else earlier.pool()
        graph = torch.cuda.CUDAGraph()
        # Other threads may go on with what they do on the device.
        with torch.cuda.graph(graph, pool=pool, capture_error_mode="thread_local"):
            outputs = function(*static, **options)
        _latest[device] = graph
        return _Graph(static, graph.replay, outputs, _idle.setdefault(device, torch.cuda.Event()))


def replayed(graph: _Graph, inputs: tuple[Tensor, ...]) -> Any:
    """The results of a graph for other inputs, as tensors of their own; the device is not waited for."""
    with torch.cuda.device(inputs[0].device):
        torch.cuda.current_stream().wait_event(graph.idle)  # of a thread that has another stream
        for static, value in zip(graph.inputs, inputs, strict=True):
            static.copy_(value, non_blocking=True)
        graph.replay()
        results = _pytree.tree_map_only(Tensor, torch.clone, graph.outputs)
        graph.idle.record()
    return results
