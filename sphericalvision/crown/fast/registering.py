# SPDX-License-Identifier: Apache-2.0
"""Functions as operators of torch, which compilers, ``meta`` tensors and autograd know."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

__all__ = ["register_operator"]

_library = torch.library.Library("sphericalvision", "FRAGMENT")


def register_operator(
    schema: str,
    compute: Callable[..., Any],
    empty: Callable[..., Any],
    gradients: Callable[..., Any],
    keep: Callable[..., None],
) -> Callable[..., Any]:
    """Register a function of tensors on the CPU and return it as an operator.

    Not by ``torch.library.custom_op``: its functions import the whole of torch's compiler when they are first called,
    which takes seconds.

    Args:
        schema: its name, arguments and results, as torch writes them.
        compute: the function.
        empty: returns tensors like its results, of no meaning, without looking at values.
        gradients: of the arguments from ``ctx`` and those of the results.
        keep: saves in ``ctx`` what these need, given all ``inputs`` and the ``output``.
    """
    name = schema.partition("(")[0]
    _library.define(schema)
    _library.impl(name, compute, "CPU")
    torch.library.register_fake(f"sphericalvision::{name}", empty, lib=_library)
    torch.library.register_autograd(f"sphericalvision::{name}", gradients, setup_context=keep, lib=_library)
    operator: Callable[..., Any] = getattr(torch.ops.sphericalvision, name)
    return operator
