# SPDX-License-Identifier: Apache-2.0
"""Two processes that each see half of the images agree on the metrics of them all."""

from pathlib import Path

import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from torch import Tensor
from torchmetrics import Metric

from sphericalvision.icosphere import Icosphere
from sphericalvision.metrics import (
    ByRegion,
    DepthError,
    DepthIndexError,
    OmniMVSError,
    SolidAngleIoU,
    SolidAngleMean,
    seam_mask,
)

SIZES = (3, 2)
"""Images of the first and of the second process: unlike, since means are over images."""


def metrics() -> dict[str, Metric]:
    grid = Icosphere(1)
    return {
        "index": DepthIndexError(16),
        "depth": DepthError(),
        "official": OmniMVSError(),
        "regions": ByRegion(DepthIndexError(16), {"seam": seam_mask(grid.vertices, 0.3)}),
        "mean": SolidAngleMean(grid),
        "labels": SolidAngleIoU(grid, num_classes=3),
    }


def update(metric: Metric, name: str, images: slice) -> None:
    generator = torch.Generator().manual_seed(0)
    pred, target = 0.2 + torch.rand(2, sum(SIZES), 42, generator=generator)
    mask = torch.rand(sum(SIZES), 42, generator=generator) > 0.3
    panoramas = torch.rand(2, sum(SIZES), 4, 8, generator=generator)
    if name == "mean":
        metric.update((pred - target).abs()[images], mask[images])
    elif name == "labels":
        metric.update(
            (3 * pred).long().clamp(max=2)[images], (3 * target).long().clamp(max=2)[images], mask[images]
        )
    elif name == "official":
        metric.update(panoramas[0, images], panoramas[1, images])
    else:
        metric.update(pred[images], target[images], mask[images])


def computed(metric: Metric) -> dict[str, Tensor]:
    values = metric.compute()
    if isinstance(values, dict):
        return values
    return values._asdict() if hasattr(values, "_asdict") else {"value": values}


def run_process(rank: int, folder: str) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=2)
    mine = slice(0, SIZES[0]) if rank == 0 else slice(SIZES[0], sum(SIZES))
    values = {}
    for name, metric in metrics().items():
        update(metric, name, mine)
        values[name] = computed(metric)
    torch.save(values, f"{folder}/{rank}.pt")
    dist.destroy_process_group()


def test_two_processes_agree_with_one(tmp_path: Path) -> None:
    mp.spawn(run_process, (str(tmp_path),), nprocs=2)
    first, second = (torch.load(tmp_path / f"{rank}.pt") for rank in range(2))
    for name, metric in metrics().items():
        update(metric, name, slice(None))
        expected = computed(metric)
        torch.testing.assert_close(first[name], expected, equal_nan=True)
        torch.testing.assert_close(second[name], expected, equal_nan=True)
