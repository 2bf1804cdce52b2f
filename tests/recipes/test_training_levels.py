# SPDX-License-Identifier: Apache-2.0
"""One set of weights for several levels: networks that share weights, samples of several levels, and batches again."""

from __future__ import annotations

import csv
import math
import re
import threading
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest
import torch

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.data import collate_samples
from sphericalvision.losses import depth_index_huber
from sphericalvision.models import IcoSweepNet, RefinedSweepNet
from sphericalvision.models.refinedsweepnet import PRIOR
from sphericalvision.recipes.datamodules.ahead import ReusedBatches
from sphericalvision.recipes.datamodules.data_module import TrainingStream
from sphericalvision.recipes.datamodules.random_rigs import LevelSamples, RandomRigDataModule
from sphericalvision.recipes.training.depth_module import DepthModule
from sphericalvision.recipes.training.rig_tables import RigTables, _tensors
from sphericalvision.recipes.training.schedule import CosineToTheEnd, progress_only
from sphericalvision.scenes.draws import Draws
from sphericalvision.scenes.random_rigs import random_rig
from tests.documented import ROOT, commands_of
from tests.recipes.tiny import Run
from tests.worlds import RANDOM_RIGS

LEVELS: dict[int, LevelSamples] = {
    3: {"share": 0.5, "batch_size": 3, "image_size": (16, 16)},
    4: {"share": 0.25, "batch_size": 2, "image_size": (24, 24)},
    5: {"share": 0.25, "batch_size": 1, "image_size": (32, 32)},
}


def network(level: int = 4) -> RefinedSweepNet:
    torch.manual_seed(0)
    return RefinedSweepNet(
        level, widths=(4, 4), blocks=1, coarse_level=3, prior={**PRIOR, "feature_channels": 4}
    )


def module_of(net: RefinedSweepNet) -> DepthModule:
    module = DepthModule(net, depth_index_huber, torch.optim.SGD, lambda optimizer: optimizer)
    module.log = lambda *_, **__: None  # type: ignore[method-assign,assignment]
    return module


def data_of(net: RefinedSweepNet, **options: Any) -> RandomRigDataModule:
    data = RandomRigDataModule(
        world=RANDOM_RIGS, image_size=(24, 24), num_train=200, batch_size=2, levels=LEVELS, **options
    )
    data.bind_network(net)
    return data


def test_a_network_at_another_level_learns_with_the_first() -> None:
    net = network()
    other = net.at_level(5)
    assert (other.level, other.coarse_level, net.level) == (5, 3, 4)
    with torch.no_grad():
        next(iter(net.refinement.parameters())).add_(1)
    for one, same in zip(net.parameters(), other.parameters(), strict=True):
        assert one is same
    normed = IcoSweepNet(3, feature_channels=2, num_cameras=2)
    buffers = dict(normed.at_level(4).named_buffers())
    assert all(
        value is buffers[name] for name, value in normed.named_buffers() if name in normed.state_dict()
    )


def test_batches_are_of_one_level_and_all_levels_come() -> None:
    net = network()
    data = data_of(net)
    stream = data.train_dataloader().dataset
    assert isinstance(stream, TrainingStream)
    sampler = data.train_dataloader().batch_sampler
    counts = dict.fromkeys(LEVELS, 0)
    for positions in islice(sampler, 60):
        ((level, _, _),) = {data.group(stream.index_at(position)) for position in positions}
        assert level is not None
        assert len(positions) == LEVELS[level]["batch_size"]
        counts[level] += 1
    assert counts[3] > counts[4] > 5 < counts[5]


def test_groups_are_those_of_the_rigs() -> None:
    """What is drawn of a rig quickly is what the rig has."""
    data = data_of(network())
    for index in range(40):
        _, number, panoramic = data.group(index)
        rig = data.rigs((24, 24))(Draws.of(index).rig)
        cameras = list(rig.cameras.values())
        assert (number, panoramic) == (len(cameras), "Equirectangular" in type(cameras[0]).__name__)


def test_every_level_trains_the_same_weights() -> None:
    net = network()
    module, data = module_of(net), data_of(net)
    seen = set()
    for batch in islice(data.train_dataloader(), 8):
        assert batch["images"].dtype == torch.uint8
        net.zero_grad()
        loss = module.training_step(batch, 0)
        loss.backward()
        assert loss.isfinite()
        assert all(value.grad is not None and value.grad.isfinite().all() for value in net.parameters())
        assert next(iter(net.prior.parameters())).grad.abs().sum() > 0  # type: ignore[union-attr]
        seen.add(batch["images"].shape[-1])
        if len(seen) == 3:
            return
    raise AssertionError(f"batches of {seen} vertices alone")


def test_tables_of_new_rigs_are_made_in_one_go() -> None:
    net = network()
    generator = torch.Generator().manual_seed(1)
    rigs = [random_rig(generator, (3,), image_size=(24, 24), panoramas=0.0) for _ in range(3)]
    tables = RigTables(net)
    together = tables.of(CameraRig.stack(rigs))
    one_by_one = tables.of(CameraRig.stack(rigs))  # met before: kept one by one
    for one, other in zip(_tensors(together), _tensors(one_by_one), strict=True):
        assert torch.equal(one, other)


def test_an_earlier_batch_comes_again_while_none_is_ready() -> None:
    gate = threading.Event()

    def loader() -> Iterator[dict[str, Any]]:
        for number in range(8):
            yield {"number": number, "turned": False}
        gate.wait(20)
        yield {"number": 8, "turned": False}

    batches = ReusedBatches(loader(), 3, lambda batch: {**batch, "turned": True})
    iterator = iter(batches)
    first = [next(iterator) for _ in range(8)]
    time.sleep(0.3)
    again = [next(iterator) for _ in range(6)]
    gate.set()
    rest = list(iterator)
    new = [batch["number"] for batch in (*first, *again, *rest) if not batch["turned"]]
    old = [batch["number"] for batch in (*first, *again, *rest) if batch["turned"]]
    assert new == list(range(9))
    assert len(old) >= 4
    assert all(old.count(number) <= 2 for number in range(9))
    assert (batches.new, batches.again) == (9, len(old))


def test_what_stops_a_loader_stops_the_training() -> None:
    def loader() -> Iterator[dict[str, Any]]:
        yield {"number": 0}
        raise ArgumentError("broken")

    with pytest.raises(ArgumentError, match="broken"):
        list(ReusedBatches(loader(), 2, dict))


@pytest.mark.parametrize(
    ("num_workers", "cached", "again"), [(1, False, True), (0, False, False), (1, True, False)]
)
def test_only_what_processes_render_anew_is_used_again(
    num_workers: int, cached: bool, again: bool, tmp_path: Path
) -> None:
    data = data_of(network(), uses=2, num_workers=num_workers, cache_dir=str(tmp_path) if cached else None)
    assert isinstance(data.train_dataloader(), ReusedBatches) == again


def test_a_batch_used_again_is_the_same_world_turned() -> None:
    net = network()
    data = data_of(net, uses=2, num_workers=1)
    batch = collate_samples([data.plain("train")[index] for index in same_group(data)])
    reused = data.train_dataloader()
    changed = reused.change(batch)
    assert changed["images"].shape == batch["images"].shape
    module = module_of(net)
    module.shows_hints = False  # they are drawn anew at each step
    for part in ("images", "inverse_depth"):
        assert torch.equal(changed[part].sort(-1).values, batch[part].sort(-1).values)
    torch.testing.assert_close(
        module.training_step(changed, 0), module.training_step(batch, 0), rtol=0.2, atol=0
    )


def same_group(data: RandomRigDataModule) -> list[int]:
    first = data.group(0)
    return [index for index in range(100) if data.group(index) == first][:2]


def test_the_schedule_ends_with_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])

    def schedule(**end: Any) -> CosineToTheEnd:
        return CosineToTheEnd(torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0), warmup=0, **end)

    timed = schedule(max_steps=1000, max_time="00:00:01:40")
    for _ in range(5):
        clock[0] += 10
        timed.optimizer.step()
        timed.step()
    assert math.isclose(timed.get_last_lr()[0], 0.505, abs_tol=1e-6)
    resumed = schedule(max_time={"seconds": 100})
    resumed.load_state_dict(progress_only(timed.state_dict()))
    clock[0] += 50
    resumed.optimizer.step()
    resumed.step()
    assert math.isclose(resumed.get_last_lr()[0], 0.01, abs_tol=1e-6)
    with pytest.raises(ArgumentError, match="an end"):
        schedule()


@pytest.mark.slow
def test_the_loss_of_the_first_steps_is_in_the_range_on_the_page(run: Run, tmp_path: Path) -> None:
    """The command of the page ends after 50 of its 600 steps."""
    page = ROOT / "docs/guide/refinedsweepnet.md"
    (words,) = (command.words for command in commands_of(page) if "trainer.max_steps=600" in command.words)
    ((low, high),) = re.findall(
        r"^\| 11 to 50 \| [\d.]+ \| ([\d.]+) to ([\d.]+) \|$", page.read_text(), re.MULTILINE
    )
    few = "trainer.max_steps=50", "scheduler.max_steps=600", "data.num_val=1", "callbacks.panels.num_frames=0"
    run("train", *words, *few, "trainer.accelerator=cpu", "output=run")
    (log,) = tmp_path.glob("run/metrics/*/metrics.csv")
    with log.open() as file:
        losses = [float(row["train/loss"]) for row in csv.DictReader(file) if row["train/loss"]]
    assert len(losses) == 50
    assert float(low) < fmean(losses[10:]) < float(high)
