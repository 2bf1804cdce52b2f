# SPDX-License-Identifier: Apache-2.0
"""Gradients that can be differentiated again: those of the reference, of what a fast function was given."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

__all__ = ["reference_gradients"]


def reference_gradients(
    reference: Callable[..., Tensor | tuple[Tensor, ...]],
    inputs: Sequence[Tensor],
    needed: Sequence[bool],
    *gradients: Tensor,
) -> list[Tensor | None]:
    """Return the gradients of ``reference(*inputs)`` as differentiable functions of the inputs and of ``gradients``.

    Operators write into buffers, which no graph can follow; so what they were given is computed once more, plainly.
    That costs time, but second derivatives are rare.

    Args:
        reference: the same function in plain torch.
        inputs: its arguments, as they were saved.
        needed: which of them want a gradient.
        gradients: of the result or of each of several.
    """
    with torch.enable_grad():
        # Views, so that a tensor that is given twice is told apart; all with a gradient, which the reference may want.
        views = [
            tensor.view_as(tensor) if tensor.requires_grad else tensor.detach().requires_grad_()
            for tensor in inputs
        ]
        result = reference(*views)
        results = (result,) if isinstance(result, Tensor) else result
        wanted = [view for view, need in zip(views, needed, strict=True) if need]
        found = iter(
            torch.autograd.grad(results, wanted, gradients, create_graph=True, materialize_grads=True)
        )
    return [next(found) if need else None for need in needed]
