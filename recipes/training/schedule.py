# SPDX-License-Identifier: Apache-2.0
"""Learning rates of several parts, each one of torch's schedulers: their product, or one after the other."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import timedelta
from typing import Any

from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import ChainedScheduler, CosineAnnealingLR, LRScheduler, SequentialLR

from sphericalvision.core import ArgumentError

__all__ = ["CosineToTheEnd", "chained", "cosine_between", "progress_only", "sequential"]

Part = Callable[[Optimizer], LRScheduler]
"""One of torch's schedulers that waits for its optimiser, as ``_partial_: true`` makes it."""

PROGRESS = ("seconds", "last_epoch", "_step_count", "_last_lr", "base_lrs", "_schedulers", "_is_initial")
"""What a stored scheduler knows of how far it is; the rest are settings, which the configuration has."""


def chained(optimizer: Optimizer, **parts: Part) -> ChainedScheduler:
    """``torch.optim.lr_scheduler.ChainedScheduler`` of named parts: at each iteration all of them act.

    Examples:
        >>> import torch
        >>> from functools import partial
        >>> optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
        >>> warmup = partial(torch.optim.lr_scheduler.LinearLR, start_factor=0.5, total_iters=1)
        >>> chained(optimizer, warmup=warmup).get_last_lr()
        [0.5]
    """
    if not parts:
        raise ArgumentError(
            "scheduler: expected named parts, each a scheduler with _partial_: true, got none"
        )
    return ChainedScheduler([part(optimizer) for part in parts.values()], optimizer)


def sequential(optimizer: Optimizer, milestones: Sequence[int], **parts: Part) -> SequentialLR:
    """``torch.optim.lr_scheduler.SequentialLR`` of named parts: each takes over at its milestone."""
    if len(parts) != len(milestones) + 1:
        raise ArgumentError(
            f"scheduler.milestones: expected an iteration between any two parts ({', '.join(parts)}), "
            f"got {list(milestones)}"
        )
    return SequentialLR(optimizer, [part(optimizer) for part in parts.values()], list(milestones))


def cosine_between(optimizer: Optimizer, begin: int, end: int, eta_min: float = 0.0) -> CosineAnnealingLR:
    """``torch.optim.lr_scheduler.CosineAnnealingLR`` that begins and ends at iterations of the whole training.

    Examples:
        >>> import torch
        >>> optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
        >>> cosine_between(optimizer, begin=100, end=1000).T_max
        900
    """
    if end <= begin:
        raise ArgumentError(
            f"scheduler.cosine: expected an end after iteration {begin}, where it begins, got {end}; train for more "
            "iterations (trainer.max_steps) or warm up for fewer (scheduler.milestones)"
        )
    return CosineAnnealingLR(optimizer, end - begin, eta_min)


class CosineToTheEnd(LRScheduler):
    """A linear rise, and half a cosine that ends where training does, by iterations or by time, whichever is sooner.

    Args:
        optimizer: whose learning rates are the highest ones.
        max_steps: iterations; -1 for any number.
        max_time: as of Lightning's trainer: ``DD:HH:MM:SS``, a time, or its parts by name; None for any time.
        warmup: iterations until the learning rate is whole.
        least: share of the learning rate at the first iteration and at the last.

    Raises:
        ArgumentError: nothing says where training ends.

    Examples:
        >>> import torch
        >>> optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
        >>> schedule = CosineToTheEnd(optimizer, max_steps=4, warmup=1, least=0.0)
        >>> for _ in range(4):
        ...     optimizer.step()
        ...     schedule.step()
        ...     print(round(schedule.get_last_lr()[0], 3))
        0.854
        0.5
        0.146
        0.0
    """

    def __init__(
        self,
        optimizer: Optimizer,
        max_steps: int = -1,
        max_time: str | Mapping[str, float] | timedelta | None = None,
        warmup: int = 100,
        least: float = 0.01,
    ) -> None:
        if max_steps < 1 and max_time is None:
            raise ArgumentError(
                "scheduler: expected an end, which the cosine goes to, got none; set trainer.max_steps or "
                "trainer.max_time"
            )
        if isinstance(max_time, str):
            days, hours, minutes, seconds = map(int, max_time.split(":"))
            max_time = timedelta(days, seconds, minutes=minutes, hours=hours)
        elif isinstance(max_time, Mapping):
            max_time = timedelta(**max_time)
        self.limit = math.inf if max_time is None else max_time.total_seconds()
        self.max_steps, self.warmup, self.least = max_steps, warmup, least
        self.seconds, self._clock = 0.0, time.monotonic()
        super().__init__(optimizer)

    def step(self, epoch: int | None = None) -> None:
        """Go on by an iteration, and by the time since the last one."""
        now = time.monotonic()
        self.seconds, self._clock = self.seconds + now - self._clock, now
        super().step(epoch)

    def get_lr(self) -> list[float | Tensor]:
        """The learning rates now."""
        steps = self.last_epoch / self.max_steps if self.max_steps > 0 else 0.0
        done = min(max(steps, self.seconds / self.limit), 1.0)
        rise = min(1.0, self.least + self.last_epoch / max(self.warmup, 1))
        factor = rise * (self.least + (1 - self.least) * (1 + math.cos(math.pi * done)) / 2)
        return [factor * highest for highest in self.base_lrs]


def progress_only(state: dict[str, Any]) -> dict[str, Any]:
    """The state of a scheduler without its settings, so that a run that goes on takes those it is given now.

    Otherwise a cosine that goes on to more iterations would keep its old end, and rise again behind it.
    """
    progress = {key: value for key, value in state.items() if key in PROGRESS}
    if "_schedulers" in progress:
        progress["_schedulers"] = [progress_only(part) for part in progress["_schedulers"]]
    return progress
