# SPDX-License-Identifier: Apache-2.0
"""Tables of tensors that are computed once, and that compilers and exported programs take for constants."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch.utils._python_dispatch import _disable_current_modes
from torch.utils._pytree import tree_leaves, tree_map_only

P = ParamSpec("P")
R = TypeVar("R")

LARGEST_TABLE = 1 << 28
"""Bytes up to which a table is kept: at level 9 of an icosphere nearly all are smaller."""


def constant_table(compute: Callable[P, R]) -> Callable[P, R]:
    """Make a function of hashable arguments keep what it returns, tensors that nobody may write to.

    Compilers and exported programs take it for a constant, and a device is asked once.
    """
    cache: dict[Any, tuple[R]] = {}

    def table(*args: P.args, **kwargs: P.kwargs) -> tuple[R]:
        key = _key(args, kwargs)
        # Not of arguments that cannot be hashed, a list, say, which the function refuses; nor inside of the transforms
        # of torch.func, whose tensors do not outlive them.
        if key is None or (key not in cache and torch._C._are_functorch_transforms_active()):
            return (compute(*args, **kwargs),)
        result = cache.get(key)
        if result is None:
            result = (_on_cpu_first(compute, args, kwargs),)
            size = _mark_static(result)
            if size <= LARGEST_TABLE:
                cache[key] = result
        return _without_real_tensors(result)

    # As `torch.compiler.assume_constant_result`, which imports the compiler: seconds of each start.
    vars(table)["_dynamo_marked_constant"] = True

    @wraps(compute)
    def constant(*args: P.args, **kwargs: P.kwargs) -> R:
        return table(*args, **kwargs)[0]  # compilers give tensors alone one name, where each wants its own

    return constant


def copied(table: Callable[P, torch.Tensor]) -> Callable[P, torch.Tensor]:
    """Make a function return a copy, to be written to, of a tensor that is kept."""

    @wraps(table)
    def copy(*args: P.args, **kwargs: P.kwargs) -> torch.Tensor:
        return table(*args, **kwargs).clone()

    return copy


def _key(args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """What a table depends on; None if it cannot be hashed. Types tell 1 from 1.0 and True."""
    values = tuple((type(value), value) for value in (*args, *kwargs.values()))
    key = values, tuple(kwargs), torch.get_default_dtype(), torch.get_default_device()
    try:
        hash(key)
    except TypeError:
        return None
    return key


def _on_cpu_first(compute: Callable[..., R], args: tuple[Any, ...], kwargs: dict[str, Any]) -> R:
    """Compute a table on the CPU and move it once to the device that the arguments name.

    A device without values cannot count, and others would be waited for. The tensors are real, and of use where
    gradients are wanted, whoever records or counts operators just now.
    """
    device = next((arg for arg in (*args, *kwargs.values()) if isinstance(arg, torch.device)), None)
    cpu = torch.device("cpu")
    with _disable_current_modes(), torch.inference_mode(False), torch.no_grad():
        if device is None:
            return compute(*args, **kwargs)
        args = tuple(cpu if arg is device else arg for arg in args)
        kwargs = {name: cpu if arg is device else arg for name, arg in kwargs.items()}
        return tree_map_only(torch.Tensor, lambda tensor: tensor.to(device), compute(*args, **kwargs))  # type: ignore[no-any-return]


def _mark_static(tables: Any) -> int:
    """Tell compilers that sizes of tables do not change, though they differ from level to level; return the bytes.

    As `torch._dynamo.mark_static`, whose import takes seconds.
    """
    tensors = [leaf for leaf in tree_leaves(tables) if isinstance(leaf, torch.Tensor)]
    for tensor in tensors:
        tensor.__dict__.update(_dynamo_static_indices=set(range(tensor.ndim)), _has_dynamo_dim_marking=True)
    return sum(tensor.nbytes for tensor in tensors)


def _without_real_tensors(tables: tuple[R]) -> tuple[R]:
    """Return tables as they are, or as fake tensors where only shapes are computed and real ones are refused."""
    fakes = torch._C._get_dispatch_mode(torch._C._TorchDispatchModeKey.FAKE)
    if fakes is None or fakes.allow_non_fake_inputs:
        return tables
    return tree_map_only(torch.Tensor, fakes.from_tensor, tables)  # type: ignore[no-any-return]
