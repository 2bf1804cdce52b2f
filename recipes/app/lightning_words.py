# SPDX-License-Identifier: Apache-2.0
"""What Lightning says of values that it refuses, in words that name the key and what to write instead."""

from __future__ import annotations

import re

__all__ = ["explained"]

MESSAGES = (
    (
        r"invalid strategy name: `strategy='([^']*)'`",
        "strategy: expected auto, ddp, ddp_spawn, fsdp, deepspeed or another strategy of Lightning's, got '{0}'",
    ),
    (
        r"invalid accelerator name: `accelerator='([^']*)'`",
        "accelerator: expected auto, cpu, gpu, mps or tpu, got '{0}'",
    ),
    (
        r"No supported gpu backend|CUDAAccelerator` can not run|MPSAccelerator` can not run",
        "accelerator: torch finds no such device on this machine; take {where}.accelerator=cpu, or auto",
    ),
    (
        r"requested gpu: (\[.*\])\s.*machine only has: (\[.*\])",
        "devices: asks for GPUs {0}, this machine has {1}",
    ),
    (
        r"strategy `(\w+)` requires a GPU accelerator",
        "strategy: {0} is for GPUs; take {where}.strategy=auto, or ddp, on a CPU",
    ),
    (
        r"devices`? selected with `CPUAccelerator`|value is not a valid input using cpu accelerator",
        "devices: on a CPU, the number of processes is expected, from 1, or auto",
    ),
    (
        r"invalid value (\S+) for (\w+), it has to be",
        "{1}: expected a whole number, or a share up to 1, got {0}",
    ),
)
"""A part of what Lightning says, and what is said in its place."""


def explained(where: str, message: str) -> str | None:
    """A message of Lightning's about the node ``where`` in our words, or None where it is not among the known.

    Examples:
        >>> explained("trainer", "No supported gpu backend found!")
        'trainer.accelerator: torch finds no such device on this machine; take trainer.accelerator=cpu, or auto'
    """
    for pattern, words in MESSAGES:
        if match := re.search(pattern, message, re.DOTALL):
            return f"{where}." + words.format(*match.groups(), where=where)
    return None
