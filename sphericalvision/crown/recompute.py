# SPDX-License-Identifier: Apache-2.0
"""Training in less memory: forget what lies inside a part of a network and compute it again when it is wanted."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm
from torch.utils.checkpoint import checkpoint

__all__ = ["RecomputedModule", "recomputed"]


def recomputed(
    module: nn.Module,
    inputs: Float[Tensor, " ..."],
    forward: Callable[[Tensor], Tensor] | None = None,
) -> Float[Tensor, " ..."]:
    """Return ``module(inputs)``, keeping only ``inputs`` for the backward pass.

    Same results and gradients for a third more work. Running statistics take one step, not two.

    Args:
        module: whose running statistics are looked after.
        inputs: of the module.
        forward: what to call; the module itself when not given.

    References:
        Chen, Xu, Zhang and Guestrin (2016), "Training deep nets with sublinear memory cost".

    Examples:
        >>> layer, inputs = nn.Linear(2, 2), torch.ones(1, 2)
        >>> torch.equal(recomputed(layer, inputs), layer(inputs))
        True
    """
    run = module if forward is None else forward
    if not torch.is_grad_enabled():
        return run(inputs)  # type: ignore[no-any-return]

    def contexts() -> tuple[AbstractContextManager[None], AbstractContextManager[None]]:
        return nullcontext(), _StillStatistics(module)

    return checkpoint(run, inputs, use_reentrant=False, context_fn=contexts)  # type: ignore[no-any-return]


class RecomputedModule(nn.Module):
    """A module of one input that in training is computed twice to save memory, if ``recompute`` says so.

    See ``set_kernel_options``.
    """

    recompute = False

    def __call__(self, inputs: Float[Tensor, " ..."]) -> Any:
        if self.recompute and self.training:
            return recomputed(self, inputs, super().__call__)
        return super().__call__(inputs)


class _StillStatistics:
    """Puts running statistics back to what they were before; may be entered again, as second derivatives do."""

    def __init__(self, module: nn.Module) -> None:
        norms = [part for part in module.modules() if isinstance(part, _BatchNorm)]
        self.buffers = [buffer for norm in norms for buffer in norm.buffers()]
        self.before: list[list[Tensor]] = []

    def __enter__(self) -> None:
        self.before.append([buffer.clone() for buffer in self.buffers])

    @torch.no_grad()
    def __exit__(self, *_: object) -> None:
        for buffer, value in zip(self.buffers, self.before.pop(), strict=True):
            buffer.copy_(value)
