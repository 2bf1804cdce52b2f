# SPDX-License-Identifier: Apache-2.0
"""Two processes that each see half of the images agree on the metrics of them all."""

from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
import torch.multiprocessing as mp

from sphericalvision.metrics import SolidAngleIoU, SolidAngleMean
from sphericalvision.sphere import Equirectangular
from tests.metrics.test_metric_laws import METRICS

GRID = Equirectangular(4, 8)


def computed(images: slice) -> dict[str, Any]:
    """Every metric of five images, or of some of them."""
    generator = torch.Generator().manual_seed(0)
    pred, target = 0.2 + torch.rand(2, 5, 4, 8, generator=generator)
    mask = torch.rand(5, 4, 8, generator=generator) > 0.3
    labels = (value.mul(3).long().clamp(max=2) for value in (pred, target))
    metrics: dict[str, Any] = {name: make() for name, (make, _) in METRICS.items()}
    for name, metric in metrics.items():
        metric.update(*(x.view(5, *METRICS[name][1])[images] for x in (pred, target, mask)))
    metrics |= {"mean": SolidAngleMean(GRID), "labels": SolidAngleIoU(GRID, num_classes=3)}
    metrics["mean"].update((pred - target).abs()[images], mask[images])
    metrics["labels"].update(*(x[images] for x in (*labels, mask)))
    return {name: metric.compute() for name, metric in metrics.items()}


def run_process(rank: int, folder: str) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=2)
    torch.save(
        computed(slice(3, 5) if rank else slice(3)), f"{folder}/{rank}.pt"
    )  # unlike, as means are over images
    dist.destroy_process_group()


def test_two_processes_agree_with_one(tmp_path: Path) -> None:
    mp.spawn(run_process, (str(tmp_path),), nprocs=2)
    expected = computed(slice(None))
    for rank in range(2):
        torch.testing.assert_close(torch.load(tmp_path / f"{rank}.pt"), expected, equal_nan=True)
