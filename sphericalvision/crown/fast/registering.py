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
    # The operator of the gradients takes those of the results, all arguments up to `end`, what is kept, what is wanted.
    kept, end = returns.count("Tensor") - results, results + len(is_tensor)

    def tensors(inputs: Sequence[Any]) -> list[Any]:
        """Of the arguments, or what there is one of for each of them, those of tensors."""
        return [x for x, is_one in zip(inputs, is_tensor, strict=True) if is_one]

    def compute_gradients(*values: Any) -> tuple[Tensor, ...]:
        # An operator returns tensors: an empty one stands for none.
        found = gradients(values[:results], values[results:end], values[end:-1], values[-1])
        return tuple(values[0].new_empty(0) if x is None else x for x in found)

    def empty_results(*inputs: Any) -> Any:
        # Of tensors without values the formula costs nothing, and says the shapes.
        found = plain(*inputs)
        several = tuple(x.new_empty(x.shape) for x in (found if isinstance(found, tuple) else [found]))
        return several if len(several) > 1 else several[0]

    def empty_gradients(*values: Any) -> tuple[Tensor, ...]:
        shapes = [
            x.shape if want else 0 for x, want in zip(tensors(values[results:end]), values[-1], strict=True)
        ]
        return tuple(values[0].new_empty(shape) for shape in shapes)

    def keep(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        # No result is kept but those that have no derivative, such as statistics: memory is for what was given.
        others = output[results:] if kept else ()
        ctx.mark_non_differentiable(*others)
        _save(ctx, (*inputs, *others))

    def differentiate(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        # As an operator, so that compilers see one call, and that it has derivatives, too.
        found = iter(backward(*upstream[:results], *_saved(ctx), tensors(ctx.needs_input_grad)))
        by_argument = [next(found) if is_one else None for is_one in is_tensor]
        return tuple(x if need else None for x, need in zip(by_argument, ctx.needs_input_grad, strict=True))

    def differentiate_again(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        values = _saved(ctx)
        wanted = values[-1]
        with torch.enable_grad():
            # Views, so that a tensor given twice is told apart; all with a gradient, which the formula may want.
            views = [
                (x.view_as(x) if x.requires_grad else x.detach().requires_grad_())
                if isinstance(x, Tensor) and x.is_floating_point()
                else x
                for x in values[:end]
            ]
            found, inputs = plain(*views[results:]), tensors(views[results:])
            by = [x for x, want in zip(inputs, wanted, strict=True) if want]
            first = found[:results] if kept else found
            # The first derivative again, now as a graph, and then that of it.
            once = torch.autograd.grad(first, by, views[:results], create_graph=True)
            given = [x for x, want in zip(upstream, wanted, strict=True) if want]
            needed = [i for i in range(end) if ctx.needs_input_grad[i]]
            twice = torch.autograd.grad(
                once, [views[i] for i in needed], given, create_graph=True, materialize_grads=True
            )
        by_place = dict(zip(needed, twice, strict=True))
        return tuple(by_place.get(i) for i in range(len(values)))

    def register(schema: str, function: Any, empty: Any, setup: Any, derivative: Any) -> Callable[..., Any]:
        name = schema.partition("(")[0]
        path = f"sphericalvision::{name}"
        _library.define(schema)
        _library.impl(name, function, "CPU")
        torch.library.register_fake(path, empty, lib=_library)
        torch.library.register_autograd(path, derivative, setup_context=setup, lib=_library)
        operator: Callable[..., Any] = getattr(torch.ops.sphericalvision, name)
        return operator

    before, after = (
        [f"Tensor {kind}{i}" for i in range(n)] for kind, n in (("gradient", results), ("kept", kept))
    )
    backward = register(
        f"{name}_backward({', '.join([*before, arguments, *after, 'bool[] wanted'])}) "
        f"-> ({', '.join(['Tensor'] * sum(is_tensor))})",
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
