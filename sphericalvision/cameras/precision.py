# SPDX-License-Identifier: Apache-2.0
"""In which floating point types cameras compute: float32 or float64, whatever they are given.

Convention:
    Points and pixels in float16 or bfloat16 are taken as the numbers that they are, and the answer is float32: in half
    precision pixel coordinates would be off by up to a few pixels. Integers are refused, and so are intrinsics in half
    precision.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from sphericalvision.core import check_floating, check_tensor

__all__ = ["HALF", "at_least_float32", "computed_in_float32"]

HALF = (torch.float16, torch.bfloat16)

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


def computed_in_float32(function: AnyFunction) -> AnyFunction:
    """Decorate a function of tensors, the first of which has a name in errors, so that it gets no half precision."""
    names = function.__code__.co_varnames  # type: ignore[attr-defined]

    @functools.wraps(function)
    def with_float32(*arguments: Any, **options: Any) -> Any:
        if arguments and isinstance(arguments[0], Tensor):
            at_least_float32(names[0], arguments[0])
            for name, value in zip(names, arguments, strict=False):
                if (
                    isinstance(value, list | tuple) and name != "image_size"
                ):  # would be indexed as tensors are
                    check_tensor(name, value, "(*,) or (*, n)")
        return function(
            *(_raised(value) for value in arguments),
            **{key: _raised(value) for key, value in options.items()},
        )

    return with_float32  # type: ignore[return-value]


def _raised(value: Any) -> Any:
    return value.float() if isinstance(value, Tensor) and value.dtype in HALF else value
