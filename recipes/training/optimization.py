# SPDX-License-Identifier: Apache-2.0
"""Adam with a schedule of the learning rate, as every training has it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import nn

from sphericalvision.core import ArgumentError, check_choice

__all__ = ["adam_with_schedule", "check_schedule", "learning_rate_factor"]


def learning_rate_factor(
    step: int,
    schedule: str,
    num_steps: int,
    warmup_steps: int = 0,
    decay_after: int = 0,
    decay_factor: float = 0.1,
) -> float:
    """Factor on the learning rate at ``step`` of ``num_steps``.

    ``"step"`` multiplies by ``decay_factor`` from ``decay_after`` on; ``"cosine"`` falls from 1 to
    ``decay_factor`` at ``num_steps``. Either rises linearly from 0 during ``warmup_steps``.

    Raises:
        ArgumentError: ``schedule`` is none of ``"constant"``, ``"step"``, ``"cosine"``.

    Examples:
        >>> [learning_rate_factor(s, "step", 6, decay_after=4) for s in (0, 3, 4, 5)]
        [1.0, 1.0, 0.1, 0.1]
        >>> round(learning_rate_factor(5, "cosine", 10, decay_factor=0.0), 3)
        0.5
    """
    check_choice("optimizer.schedule", schedule, ("constant", "step", "cosine"))
    warmup = min(1.0, (step + 1) / warmup_steps) if warmup_steps else 1.0
    if schedule == "step":
        return warmup * (decay_factor if step >= decay_after else 1.0)
    if schedule == "cosine":
        progress = min(1.0, step / max(1, num_steps))
        return warmup * (decay_factor + (1.0 - decay_factor) * 0.5 * (1.0 + math.cos(math.pi * progress)))
    return warmup


def check_schedule(schedule: str, schedule_steps: int) -> None:
    """Refuse a schedule that is unknown or a cosine without an end.

    Raises:
        ArgumentError: the message names the key and what to set.
    """
    learning_rate_factor(0, schedule, schedule_steps)
    if schedule == "cosine" and schedule_steps <= 0:
        raise ArgumentError(
            f"optimizer.schedule_steps: a cosine needs the number of iterations, got {schedule_steps}; "
            "set trainer.max_steps or optimizer.schedule_steps"
        )


def adam_with_schedule(parameters: Iterable[nn.Parameter], h: Mapping[str, Any]) -> Any:
    """Adam with the schedule stepped at every iteration, from a module's hyper-parameters."""
    optimizer = torch.optim.Adam(parameters, h["learning_rate"], weight_decay=h["weight_decay"])
    names = ("schedule", "schedule_steps", "warmup_steps", "decay_after", "decay_factor")
    schedule = [h[name] for name in names]
    scheduler = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: learning_rate_factor(step, *schedule)
    )
    return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}
