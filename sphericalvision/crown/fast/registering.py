# SPDX-License-Identifier: Apache-2.0
"""Functions as operators of torch, which compilers, ``meta`` tensors and autograd know, with derivatives of any order.

Operators write into buffers, which no graph can follow. So the first derivative is an operator of its own, and further
ones are those of a plain formula, of what the operator was given: that costs time, but second derivatives are rare.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

__all__ = ["register_operator"]

_library = torch.library.Library("sphericalvision", "FRAGMENT")


def register_operator(
    schema: str,
    compute: Callable[..., Any],
    gradients: Callable[..., Sequence[Tensor | None]],
    plain: Callable[..., Any],
    results: int = 1,
) -> Callable[..., Any]:
    """Register a function of tensors on the CPU, whose results are contiguous, and return it as an operator.

    Not by ``torch.library.custom_op``: its functions import the whole of torch's compiler when they are first called,
    which takes seconds.

    Args:
        schema: its name, arguments without defaults and results, as torch writes them.
        compute: the function.
        gradients: of all tensors among its arguments, None for those not wanted, from the gradients of the results, the
            arguments, the results that are kept, and what is ``wanted``.
        plain: a formula of the same results in plain torch, by which they are differentiated more than once.
        results: how many of the results are differentiable; the others are kept for ``gradients``.
    """
    name, arguments, returns = schema.replace(") -> ", "(").split("(", 2)
    is_tensor = [argument.strip().startswith("Tensor") for argument in arguments.split(",")]
    kept = returns.count("Tensor") - results

    def split(values: Sequence[Any]) -> tuple[Sequence[Any], Sequence[Any], Sequence[Any], list[bool]]:
        """Of the gradients' operator: gradients of the results, arguments, kept results, what is wanted."""
        *first, wanted = values
        end = results + len(is_tensor)
        return first[:results], first[results:end], first[end:], wanted

    def compute_gradients(*values: Any) -> tuple[Tensor, ...]:
        upstream, inputs, others, wanted = split(values)
        found = gradients(upstream, inputs, others, wanted)
        return tuple(upstream[0].new_empty(0) if x is None else x for x in found)

    def empty_results(*inputs: Any) -> Any:
        found = plain(*inputs)
        several = tuple(x.new_empty(x.shape) for x in (found if isinstance(found, tuple) else [found]))
        return several if len(several) > 1 else several[0]

    def empty_gradients(*values: Any) -> tuple[Tensor, ...]:
        upstream, inputs, _, wanted = split(values)
        tensors = [x for x, is_one in zip(inputs, is_tensor, strict=True) if is_one]
        return tuple(
            upstream[0].new_empty(x.shape if want else 0) for x, want in zip(tensors, wanted, strict=True)
        )

    def keep(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        others = output[results:] if kept else ()
        ctx.mark_non_differentiable(*others)
        _save(ctx, (*inputs, *others))

    def differentiate(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        wanted = [want for want, is_one in zip(ctx.needs_input_grad, is_tensor, strict=True) if is_one]
        found = iter(backward(*upstream[:results], *_saved(ctx), wanted))
        by_argument = [next(found) if is_one else None for is_one in is_tensor]
        return tuple(x if need else None for x, need in zip(by_argument, ctx.needs_input_grad, strict=True))

    def differentiate_again(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        values = _saved(ctx)
        *_, wanted = values
        given = values[: results + len(is_tensor)]
        variable = [i for i, x in enumerate(given) if isinstance(x, Tensor) and x.is_floating_point()]
        with torch.enable_grad():
            # Views, so that a tensor given twice is told apart; all with a gradient, which the formula may want.
            views = {
                i: given[i].view_as(given[i])
                if given[i].requires_grad
                else given[i].detach().requires_grad_()
                for i in variable
            }
            first, inputs, _, _ = split(
                [*(views.get(i, x) for i, x in enumerate(given)), *values[len(given) :]]
            )
            found = plain(*inputs)
            tensors = [x for x, is_one in zip(inputs, is_tensor, strict=True) if is_one]
            once = torch.autograd.grad(
                found[:results] if kept else found,
                [x for x, want in zip(tensors, wanted, strict=True) if want],
                first,
                create_graph=True,
            )
            needed = [i for i in variable if ctx.needs_input_grad[i]]
            of_once = [x for x, want in zip(upstream, wanted, strict=True) if want]
            by = [views[i] for i in needed]
            twice = torch.autograd.grad(once, by, of_once, create_graph=True, materialize_grads=True)
        by_place = dict(zip(needed, twice, strict=True))
        return tuple(by_place.get(i) for i in range(len(values)))

    def register(schema: str, function: Any, empty: Any, setup: Any, derivative: Any) -> Callable[..., Any]:
        name = schema.partition("(")[0]
        _library.define(schema)
        _library.impl(name, function, "CPU")
        torch.library.register_fake(f"sphericalvision::{name}", empty, lib=_library)
        torch.library.register_autograd(
            f"sphericalvision::{name}", derivative, setup_context=setup, lib=_library
        )
        operator: Callable[..., Any] = getattr(torch.ops.sphericalvision, name)
        return operator

    taken = ", ".join([*(f"Tensor gradient{i}" for i in range(results)), arguments])
    taken = ", ".join([taken, *(f"Tensor kept{i}" for i in range(kept)), "bool[] wanted"])
    backward = register(
        f"{name}_backward({taken}) -> ({', '.join(['Tensor'] * sum(is_tensor))})",
        compute_gradients,
        empty_gradients,
        lambda ctx, inputs, output: _save(ctx, inputs),
        differentiate_again,
    )
    return register(schema, compute, empty_results, keep, differentiate)


def _save(ctx: Any, values: Sequence[Any]) -> None:
    ctx.save_for_backward(*(x if isinstance(x, Tensor) else None for x in values))
    ctx.others = [None if isinstance(x, Tensor) else x for x in values]


def _saved(ctx: Any) -> list[Any]:
    return [other if x is None else x for x, other in zip(ctx.saved_tensors, ctx.others, strict=True)]
