# SPDX-License-Identifier: Apache-2.0
"""In which floating point types cameras compute: float32 or float64, whatever they are given.

Convention:
    Points and pixels in float16 or bfloat16 are taken as the numbers that they are, and the answer is float32: in half
    precision pixel coordinates would be off by up to a few pixels. Integers are refused, and so are intrinsics in half
    precision.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from sphericalvision.core import check_floating, check_last_dim, check_tensor

__all__ = ["HALF", "at_least_float32", "model_function"]

HALF = (torch.float16, torch.bfloat16)
_PAIRS = ("image_size", "latitudes", "longitudes")  # of plain numbers

AnyFunction = TypeVar("AnyFunction", bound=Callable[..., Any])


def at_least_float32(name: str, values: Shaped[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """``values`` (*), in float32 if they are in half precision.

    Raises:
        ArgumentError: they are integers.

    Examples:
        >>> at_least_float32("points", torch.zeros(3, dtype=torch.bfloat16)).dtype
        torch.float32
    """
    check_floating(name, values)
    return values.float() if values.dtype in HALF else values


def model_function(function: AnyFunction) -> AnyFunction:
    """Decorate a function of ``points`` (*, 3) or ``pixels`` (*, 2) and intrinsics, so that it gets no half precision.

    It then raises ``ShapeError`` where the last dimension is another one, and ``ArgumentError`` for
    integers and for lists in place of tensors.
    """
    names = tuple(inspect.signature(function).parameters)
    size = {"points": 3, "pixels": 2}[names[0]]

    @functools.wraps(function)
    def checked(*arguments: Any, **options: Any) -> Any:
        values: Any = arguments[0] if arguments else options.get(names[0])
        check_last_dim(names[0], values, size)
        at_least_float32(names[0], values)
        for name, value in zip(names, arguments, strict=False):
            if isinstance(value, list | tuple) and name not in _PAIRS:  # would be indexed as tensors are
                check_tensor(name, value, "(*,) or (*, n)")
        return function(
            *(_raised(value) for value in arguments),
            **{key: _raised(value) for key, value in options.items()},
        )

    return checked  # type: ignore[return-value]


def _raised(value: Any) -> Any:
    return value.float() if isinstance(value, Tensor) and value.dtype in HALF else value
