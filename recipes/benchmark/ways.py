# SPDX-License-Identifier: Apache-2.0
"""Ways to run the same work, and what is measured of a run."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils.flop_counter import FlopCounterMode

from sphericalvision.core import kernels, reference_kernels

__all__ = ["OURS", "both_ways", "by", "count_gbyte", "count_gflop", "cpu_seconds"]

OURS = "sphericalvision"
Run = Callable[[], Any]


def by(way: str, run: Run) -> Run:
    """The same in a way of ``kernels``: ``"reference"``, the readable formulas alone; ``"plain"``, layers in torch."""

    def in_that_way() -> Any:
        with kernels(way):
            return run()

    return in_that_way


def both_ways(run: Run) -> dict[str, Run]:
    """Inference by the readable formulas, and as it is usually done."""
    usual = torch.inference_mode()(run)
    return {"plain": by("reference", usual), OURS: usual}


def cpu_seconds(run: Run) -> Callable[[], float]:
    """CPU time of a run, which other processes do not change; tables are made, and caches filled, before."""
    run()

    def timed() -> float:
        start = time.process_time()
        run()
        return time.process_time() - start

    return timed


def count_gflop(run: Run) -> float:
    """Operations of convolutions and matrix products in 1e9, done directly; counted on shapes alone."""
    counter = FlopCounterMode(display=False)
    with torch.no_grad(), reference_kernels(), FakeTensorMode(allow_non_fake_inputs=True), counter:
        run()
    return float(counter.get_total_flops()) / 1e9


def count_gbyte(*tensors: Tensor) -> float:
    """What tensors weigh, in 1e9 bytes."""
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors) / 1e9
