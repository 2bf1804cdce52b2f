# SPDX-License-Identifier: Apache-2.0
"""How things are computed: ``kernels`` chooses for a block of code, and an ``Operator`` picks one of its bodies."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache, update_wrapper, wraps
from importlib.util import find_spec
from typing import Any, Generic, ParamSpec, TypeVar

import torch
from torch import Tensor

from sphericalvision.core import check_choice

__all__ = ["kernels", "reference_kernels"]

KERNELS = ("auto", "plain", "graph", "reference", "require")

P = ParamSpec("P")
R = TypeVar("R")


class _Block:
    """An open ``kernels`` block, equal to itself alone."""

    def __init__(self, mode: str) -> None:
        self.mode = mode


_open_blocks: list[_Block] = []
"""Of all threads. It is appended to and removed from, which are one step each: none is lost, and none stays."""


@contextmanager
def kernels(mode: str) -> Iterator[None]:
    """Choose how everything inside is computed; the numbers are the same but for rounding.

    ``"auto"``
        As outside of all blocks: by operators in C++ where they can be had, which are compiled beside the work.
    ``"plain"``
        By layers in torch alone, as ``"auto"`` does where there is no compiler.
    ``"graph"``
        By few large operators of torch, as ``"auto"`` does on a device that is not a CPU, in ``torch.compile`` and in
        exported programs.
    ``"reference"``
        By the readable formulas alone, which are differentiable any number of times.
    ``"require"``
        By operators in C++ wherever they can at all, in double precision, too; they are waited for.

    The environment variable ``SPHERICALVISION_KERNELS`` chooses for a whole process. Blocks count for all threads, and
    may be nested: the one opened last decides.

    Args:
        mode: one of these.

    Raises:
        ArgumentError: another mode.
        MissingCompilerError: with ``"require"``, inside, if there are no operators and they cannot be compiled.

    Examples:
        >>> with kernels("reference"):
        ...     with kernels("plain"):
        ...         kernel_mode()
        'plain'
    """
    check_choice("kernels", mode, KERNELS)
    block = _Block(mode)
    _open_blocks.append(block)
    try:
        yield
    finally:
        _open_blocks.remove(block)


def reference_kernels() -> AbstractContextManager[None]:
    """Compute everything inside by the readable formulas, without the faster ways to the same numbers.

    Short for ``kernels("reference")``: for comparison, and for derivatives of any order.

    Examples:
        >>> with reference_kernels():
        ...     kernel_mode()
        'reference'
    """
    return kernels("reference")


def kernel_mode() -> str:
    """Return the mode of ``kernels`` that is in force."""
    with suppress(IndexError):  # there is none, or another thread has just closed the last one
        return _open_blocks[-1].mode
    mode = os.environ.get("SPHERICALVISION_KERNELS") or "auto"
    check_choice("SPHERICALVISION_KERNELS", mode, KERNELS)
    return mode


def prefer_fused(device: torch.device) -> bool:
    """Whether few large operators are preferred on a device, none of which waits for values.

    So it is on anything but a CPU, which a host would have to feed otherwise; for compilers and exported programs; and
    within ``kernels("graph")``. On a CPU loops over samples and cameras pay, as what belongs together stays in its
    cache, and so do steps that only look at what is left to be done.

    Examples:
        >>> prefer_fused(torch.device("cpu")), prefer_fused(torch.device("cuda"))
        (False, True)
    """
    mode = kernel_mode()
    return mode == "graph" or (
        mode != "reference" and (device.type != "cpu" or torch.compiler.is_compiling())
    )


def may_hold(condition: Tensor) -> bool:
    """Whether a condition may hold anywhere: False only if a CPU sees that it holds nowhere.

    A device would have to be waited for, and what depends on the condition is computed anyway.
    """
    return prefer_fused(condition.device) or bool(condition.any())


def is_transformed() -> bool:
    """Whether a transform of ``torch.func`` is at work, which takes functions apart that torch knows."""
    return torch._C._are_functorch_transforms_active()


def is_traced() -> bool:
    """Whether a compiler or a transform of ``torch.func`` follows what is computed, and values cannot be looked at."""
    return torch.compiler.is_compiling() or is_transformed()


def uses_reference_kernels() -> bool:
    """Whether the readable formulas are asked for."""
    return kernel_mode() == "reference"


@cache
def runs_triton(device: torch.device) -> bool:
    """Whether kernels in Triton run on a device: on NVIDIA's from Volta on, with Triton and a C compiler at hand.

    Triton comes with torch for CUDA on Linux; what starts a kernel it compiles by ``CC``, gcc or clang.

    Examples:
        >>> runs_triton(torch.device("cpu"))
        False
    """
    if device.type != "cuda" or find_spec("triton") is None:
        return False
    compilers = os.environ.get("CC") or "gcc", "gcc", "clang"
    return any(map(shutil.which, compilers)) and torch.cuda.get_device_capability(device) >= (7, 0)


class Operator(Generic[P, R]):
    """A function of tensors with several bodies, of which one is picked for each call.

    The readable one says what is computed, runs everywhere and is differentiable any number of times; it is all that
    ``kernels("reference")`` runs. The others return the same but for rounding. One that does not fit its arguments
    returns ``NotImplemented``, and the next is asked:

    ==========  ========================================================================================================
    ``cpp``     operators in C++, on a CPU, once they are compiled
    ``triton``  kernels in Triton, on CUDA devices; compilers and programs that leave this package do without
    ``cpu``     torch, so that what belongs together stays in a CPU's cache, or with gradients of our own
    ``fused``   few large operators of torch that wait for no value: for devices, compilers and ``kernels("graph")``
    ==========  ========================================================================================================

    Args:
        readable: the formula in torch.
        cpp: see above, as for the others; none where nothing is gained.
        triton: without derivatives, unless ``differentiable_triton``.
        cpu: for eager torch alone.
        fused: for everything that ``prefer_fused``.
        differentiable_triton: whether the kernel in Triton has derivatives.

    Examples:
        >>> double = Operator(lambda x: x + x, cpu=lambda x: 2 * x if x.is_floating_point() else NotImplemented)
        >>> double(torch.tensor([1, 2]))
        tensor([2, 4])
    """

    def __init__(
        self,
        readable: Callable[P, R],
        *,
        cpp: Callable[..., Any] | None = None,
        triton: Callable[..., Any] | None = None,
        cpu: Callable[..., Any] | None = None,
        fused: Callable[..., Any] | None = None,
        differentiable_triton: bool = False,
    ) -> None:
        self.readable = readable
        self.bodies = {"cpp": cpp, "triton": triton, "cpu": cpu, "fused": fused}
        self.differentiable_triton = differentiable_triton
        update_wrapper(self, readable)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        for kind in _kinds(_tensors((*args, *kwargs.values())), self.differentiable_triton):
            body = self.bodies[kind]
            result = NotImplemented if body is None else body(*args, **kwargs)
            if result is not NotImplemented:
                return result
        return self.readable(*args, **kwargs)


def _kinds(tensors: list[Tensor], differentiable_triton: bool) -> tuple[str, ...]:
    """Return which bodies of an operator to ask, one after the other: the one place that chooses."""
    mode, device = kernel_mode(), tensors[0].device
    if mode == "reference":
        return ()
    compiling = torch.compiler.is_compiling()
    cpp = ("cpp",) if mode in ("auto", "require") and device.type == "cpu" and not is_transformed() else ()
    if not prefer_fused(device):
        # Functions with gradients of our own, and loops that look at values, are not for the transforms of torch.func.
        return () if is_transformed() else (*cpp, "cpu")
    if compiling or device.type == "cpu":
        return (*cpp, "fused") if compiling and not torch.compiler.is_exporting() else ("fused",)
    if is_transformed() or not runs_triton(device):
        return ("fused",)
    differentiated = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    return ("triton", "fused") if differentiable_triton or not differentiated else ("fused",)


def _tensors(values: Any) -> list[Tensor]:
    """Tensors among arguments, also those inside of tuples and lists."""
    tensors: list[Tensor] = []
    for value in values:
        if isinstance(value, Tensor):
            tensors.append(value)
        elif isinstance(value, tuple | list):
            tensors += _tensors(value)
    return tensors


def full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function compute in the precision of what it is given, inside of ``torch.autocast`` too.

    For geometry: products of matrices in bfloat16 would move pixels and triangles.

    Examples:
        >>> @full_precision
        ... def product(a, b):
        ...     return a @ b
        >>> with torch.autocast("cpu", torch.bfloat16):
        ...     product(torch.ones(2, 2), torch.ones(2, 2)).dtype
        torch.float32
    """

    @wraps(function)
    def exact(*args: P.args, **kwargs: P.kwargs) -> R:
        device = next((kind for kind in ("cpu", "cuda", "mps") if torch.is_autocast_enabled(kind)), None)
        if device is None:
            return function(*args, **kwargs)
        with torch.autocast(device, enabled=False):
            return exact(*args, **kwargs)

    return exact
