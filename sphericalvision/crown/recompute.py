# SPDX-License-Identifier: Apache-2.0
"""Training in less memory: the inside of parts of a network is computed again in the backward pass, not kept."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm
from torch.utils.checkpoint import checkpoint

from sphericalvision.core import ArgumentError
from sphericalvision.crown.fast import mode_in_use, recomputation_pays
from sphericalvision.crown.layout import Crown
from sphericalvision.kernels import kernels

LARGE = 2**23
"""Bytes of a crown from which on ``recompute_if_large`` does: 21 MB of 32 channels at level 6, 1.4 MB at level 4."""


class RecomputedModule(nn.Module):
    """A module that keeps only its inputs for the backward pass if ``recompute`` is set.

    Its inside is computed again in the backward pass: the same results and gradients for a third more work.
    Running statistics take one step, not two. See ``set_kernel_options``.

    References:
        Chen, Xu, Zhang and Guestrin (2016), "Training deep nets with sublinear memory cost".

    Examples:
        >>> class Layer(RecomputedModule, nn.Linear):
        ...     pass
        >>> layer, inputs = Layer(2, 2), torch.ones(1, 2)
        >>> expected = layer(inputs)
        >>> layer.recompute = True
        >>> torch.equal(layer(inputs), expected)
        True
    """

    recompute = False

    def __call__(self, *inputs: Any) -> Any:
        run = super().__call__
        if not (self.recompute and self.training and torch.is_grad_enabled()):
            return run(*inputs)
        return _checkpointed(run, self, *inputs)


def recompute_if_large(module: nn.Module, crown: Crown) -> Any:
    """Apply a module, which training computes twice if the crown is so large that memory matters more than calls.

    Only if operators in C++ are in use; layers in torch and the readable formulas compute nothing twice.
    """
    if not (module.training and torch.is_grad_enabled() and recomputation_pays(crown.col)):
        return module(crown)
    return _checkpointed(module, module, crown) if sum(x.nbytes for x in crown) >= LARGE else module(crown)


def _checkpointed(run: Callable[..., Any], module: nn.Module, *inputs: Any) -> Any:
    """Call ``run``, which applies a module, keep only its inputs, and call it again in the backward pass."""
    way = mode_in_use()  # twice, or other tensors would be saved than are asked for

    def contexts() -> tuple[AbstractContextManager[None], AbstractContextManager[None]]:
        return kernels(way), _StatisticsRestored(module, way)

    return checkpoint(run, *inputs, use_reentrant=False, context_fn=contexts)


class _StatisticsRestored(AbstractContextManager[None]):
    """Restores running statistics at its end; second derivatives enter it again."""

    def __init__(self, module: nn.Module, way: str) -> None:
        norms = [part for part in module.modules() if isinstance(part, _BatchNorm)]
        self.buffers = [buffer for norm in norms for buffer in norm.buffers()]
        self.way = way
        self.open: list[tuple[AbstractContextManager[None], list[Tensor]]] = []

    def __enter__(self) -> None:
        block = kernels(self.way)
        block.__enter__()
        self.open.append((block, [buffer.clone() for buffer in self.buffers]))

    @torch.no_grad()
    def __exit__(self, *error: Any) -> None:
        block, before = self.open.pop()
        block.__exit__(*error)
        for buffer, value in zip(self.buffers, before, strict=True):
            buffer.data.copy_(value)  # see `_track` of the operators, why through ``data``


def set_kernel_options(module: nn.Module, *, recompute: bool) -> None:
    """Choose how the layers inside a network are computed, at any time; the results stay the same.

    Args:
        module: the network, or a part of it.
        recompute: whether training saves memory by computing the inside of blocks twice, for a third more work.

    Raises:
        ArgumentError: if no layer offers that choice.

    Examples:
        >>> from sphericalvision.crown import CrownBlock3d
        >>> block = CrownBlock3d(2, 2, 2)
        >>> set_kernel_options(block, recompute=True)
        >>> recomputes(block)
        True
    """
    modules = [part for part in module.modules() if isinstance(part, RecomputedModule)]
    if recompute and not modules:
        raise ArgumentError(f"recompute: {type(module).__name__} has nothing to choose there; leave it out")
    for part in modules:
        part.recompute = recompute


def recomputes(module: nn.Module) -> bool:
    """Return whether the inside of any block of a network is computed twice in training."""
    return any(part.recompute for part in module.modules() if isinstance(part, RecomputedModule))
