# SPDX-License-Identifier: Apache-2.0
"""A learning rate that is the product of several of torch's schedulers."""

from collections.abc import Callable
from typing import Any

from torch.optim import Optimizer
from torch.optim.lr_scheduler import ChainedScheduler, LRScheduler

from sphericalvision.core import ArgumentError

Schedule = Callable[[Optimizer], LRScheduler]
"""One of torch's schedulers that waits for its optimiser, as ``_partial_: true`` makes it."""

PROGRESS = ("last_epoch", "_step_count", "_last_lr", "base_lrs", "_schedulers", "_is_initial")
"""Keys of a stored scheduler that say how far it is; the rest are settings, which the configuration has."""


def chained(optimizer: Optimizer, **schedules: Schedule) -> ChainedScheduler:
    """``torch.optim.lr_scheduler.ChainedScheduler`` of named schedules: at each iteration all of them act.

    Examples:
        >>> import torch
        >>> from functools import partial
        >>> optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
        >>> warmup = partial(torch.optim.lr_scheduler.LinearLR, start_factor=0.5, total_iters=1)
        >>> chained(optimizer, warmup=warmup).get_last_lr()
        [0.5]
    """
    if not schedules:
        raise ArgumentError(
            "scheduler: expected named parts, each a scheduler with _partial_: true, got none"
        )
    return ChainedScheduler([schedule(optimizer) for schedule in schedules.values()], optimizer)


def progress_only(state: dict[str, Any]) -> dict[str, Any]:
    """The state of a scheduler without its settings, so that a run that goes on takes those it is given now.

    Otherwise a cosine that goes on to more iterations would keep its old end, and rise again behind it.
    """
    progress = {key: value for key, value in state.items() if key in PROGRESS}
    if "_schedulers" in progress:
        progress["_schedulers"] = [progress_only(state) for state in progress["_schedulers"]]
    return progress
