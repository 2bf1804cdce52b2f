# SPDX-License-Identifier: Apache-2.0
"""Functions as operators of torch, which compilers, ``meta`` tensors and autograd know, with derivatives of any order.

Operators write into buffers, which no graph can follow. So a function becomes two operators, and every derivative is
the work of the next line:

==================  ==============================  ==========================================================
operator            computes by                     its derivative
==================  ==============================  ==========================================================
``name``            ``compute``                     the operator ``name_backward``
``name_backward``   ``gradients``                   the plain formula, differentiated twice by autograd: slow,
                                                    but second derivatives are rare
==================  ==============================  ==========================================================
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

_library = torch.library.Library("sphericalvision", "FRAGMENT")


class _BackwardArguments(NamedTuple):
    """What the operator of the gradients is given, one after the other."""

    upstream: Sequence[Tensor]  # gradients of the differentiable results
    inputs: Sequence[Any]  # arguments of the function
    statistics: Sequence[Tensor]
    needs_grad: Sequence[bool]  # for each tensor among the inputs


class Operator:
    """A function of tensors on the CPU, whose results are contiguous, registered with torch.

    Not by ``torch.library.custom_op``: its functions import the whole of torch's compiler when they are first called,
    which takes seconds.

    Args:
        schema: its name, arguments without defaults and results, as torch writes them.
        compute: the function.
        gradients: of all tensors among its arguments, None for those that need none: a function of the gradients of the
            results, the arguments, the statistics, and for each tensor whether its gradient is needed.
        plain: a formula of the same results in plain torch, by which they are differentiated more than once.
        num_differentiable: how many of the results are; those after them are statistics, and reach ``gradients``.

    Attributes:
        forward: the operator, to be called.
        backward: that of its gradients.
    """

    def __init__(
        self,
        schema: str,
        compute: Callable[..., Any],
        gradients: Callable[..., Sequence[Tensor | None]],
        plain: Callable[..., Any],
        num_differentiable: int = 1,
    ) -> None:
        name, arguments, returns = schema.replace(") -> ", "(").split("(", 2)
        self.gradients, self.plain, self.num_differentiable = gradients, plain, num_differentiable
        self.is_tensor = [argument.strip().startswith("Tensor") for argument in arguments.split(",")]
        statistics = [f"Tensor statistic{i}" for i in range(returns.count("Tensor") - num_differentiable)]
        upstream = [f"Tensor gradient{i}" for i in range(num_differentiable)]
        self.has_statistics = bool(statistics)
        self.backward = _register(
            f"{name}_backward({', '.join([*upstream, arguments, *statistics, 'bool[] needs_grad'])}) "
            f"-> ({', '.join(['Tensor'] * sum(self.is_tensor))})",
            self._compute_gradients,
            self._empty_gradients,
            lambda ctx, inputs, output: _save(ctx, inputs),
            self._differentiate_backward,
        )
        self.forward = _register(schema, compute, self._empty_results, self._keep, self._differentiate)

    # Of the function.

    def _empty_results(self, *inputs: Any) -> Any:
        # On tensors without values the formula costs nothing and gives the shapes.
        results = self.plain(*inputs)
        if isinstance(results, Tensor):
            return results.new_empty(results.shape)
        return tuple(x.new_empty(x.shape) for x in results)

    def _keep(self, ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        # Differentiable results are not kept: memory is for the inputs, and gradients follow from these.
        statistics = output[self.num_differentiable :] if self.has_statistics else ()
        ctx.mark_non_differentiable(*statistics)
        _save(ctx, (*inputs, *statistics))

    def _differentiate(self, ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        # By an operator, so that compilers see one call, and that it can be differentiated in turn.
        needs_grad = self._tensors(ctx.needs_input_grad)
        gradients = iter(self.backward(*upstream[: self.num_differentiable], *_saved(ctx), needs_grad))
        by_argument = [next(gradients) if is_tensor else None for is_tensor in self.is_tensor]
        return tuple(x if needs else None for x, needs in zip(by_argument, ctx.needs_input_grad, strict=True))

    # Of its gradients.

    def _compute_gradients(self, *values: Any) -> tuple[Tensor, ...]:
        # An operator returns tensors: an empty one marks a gradient that is not needed.
        gradients = self.gradients(*self._split(values))
        return tuple(values[0].new_empty(0) if x is None else x for x in gradients)

    def _empty_gradients(self, *values: Any) -> tuple[Tensor, ...]:
        _, inputs, _, needs_grad = self._split(values)
        pairs = zip(self._tensors(inputs), needs_grad, strict=True)
        return tuple(values[0].new_empty(x.shape if needs else 0) for x, needs in pairs)

    def _differentiate_backward(self, ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        values = _saved(ctx)
        _, _, statistics, needs_grad = self._split(values)
        end = len(values) - len(statistics) - 1  # the gradients of the results and the inputs are before it
        with torch.enable_grad():
            # Views, so that one tensor as two arguments has two gradients; all of them may be asked for.
            views = [
                (x.view_as(x) if x.requires_grad else x.detach().requires_grad_())
                if isinstance(x, Tensor) and x.is_floating_point()
                else x
                for x in values[:end]
            ]
            result_gradients, inputs = views[: self.num_differentiable], views[self.num_differentiable :]
            results = self.plain(*inputs)
            results = results[: self.num_differentiable] if self.has_statistics else results
            # The first derivative again, now as a graph, and then the derivative of that.
            first_order = torch.autograd.grad(
                results, _where(needs_grad, self._tensors(inputs)), result_gradients, create_graph=True
            )
            needed = [i for i in range(end) if ctx.needs_input_grad[i]]
            second_order = torch.autograd.grad(
                first_order,
                [views[i] for i in needed],
                _where(needs_grad, upstream),
                create_graph=True,
                materialize_grads=True,
            )
        by_index = dict(zip(needed, second_order, strict=True))
        return tuple(by_index.get(i) for i in range(len(values)))

    def _split(self, values: Sequence[Any]) -> _BackwardArguments:
        start, end = self.num_differentiable, self.num_differentiable + len(self.is_tensor)
        return _BackwardArguments(values[:start], values[start:end], values[end:-1], values[-1])

    def _tensors(self, by_argument: Sequence[Any]) -> list[Any]:
        """Of the arguments, or of one thing for each of them, those of tensors."""
        return _where(self.is_tensor, by_argument)


def _register(schema: str, function: Any, empty: Any, setup: Any, derivative: Any) -> Callable[..., Any]:
    name = schema.partition("(")[0]
    path = f"sphericalvision::{name}"
    _library.define(schema)
    _library.impl(name, function, "CPU")
    torch.library.register_fake(path, empty, lib=_library)
    torch.library.register_autograd(path, derivative, setup_context=setup, lib=_library)
    operator: Callable[..., Any] = getattr(torch.ops.sphericalvision, name)
    return operator


def _where(mask: Sequence[bool], values: Sequence[Any]) -> list[Any]:
    return [value for value, chosen in zip(values, mask, strict=True) if chosen]


def _save(ctx: Any, values: Sequence[Any]) -> None:
    ctx.save_for_backward(*(x if isinstance(x, Tensor) else None for x in values))
    ctx.others = [None if isinstance(x, Tensor) else x for x in values]


def _saved(ctx: Any) -> list[Any]:
    return [other if x is None else x for x, other in zip(ctx.saved_tensors, ctx.others, strict=True)]
