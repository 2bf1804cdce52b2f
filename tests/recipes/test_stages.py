# SPDX-License-Identifier: Apache-2.0
"""Stages of ``experiment=refinedsweepnet``, as small as they get: each from the one before, to the same weights."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from sphericalvision.core import ArgumentError
from sphericalvision.models import IcoSweepNet, RefinedSweepNet, load_weights, save_weights
from sphericalvision.recipes.app.cli import build
from sphericalvision.recipes.datamodules.clues import SamplesWithClues, clue_bytes, prior_of
from sphericalvision.recipes.training.depth_module import DepthModule
from tests.recipes.conftest import run_recipe
from tests.recipes.test_batches import module_of
from tests.recipes.tiny import Run, composed

STAGES = ("prior", "coarse", "fusion", "finer", "longer", "further", "sharper", "clutter", "hints")
LAST = STAGES[3:]
SMALL = """
# @package _global_
defaults: [/experiment/refinedsweepnet/{stage}]
result: ${{paths.stages}}/{stage}.safetensors
model: {{level: 4, feature_channels: 4}}
data:
  image_size: [16, 16]
  num_val: 1
  levels:
    5: {{times: 0}}
    6: {{times: 0}}
    3: {{seeds: [0, 4], times: 1, batch_size: 1, image_size: [16, 16]}}
    4: {{seeds: [100, 2], times: 1, batch_size: 1, image_size: [16, 16]}}
trainer: {{max_steps: 3, val_check_interval: 3, enable_model_summary: false, accelerator: cpu}}
callbacks: {{panels: null}}
"""
SIZES = (
    "{level: 4, coarse_level: 3, widths: [4, 4], blocks: 1, refining_blocks: 1, prior: {feature_channels: 4, "
    "volume_channels: 8, norm: instance, aggregation: variance, feature_coarsening: 1}}"
)
WORDS = ("experiment=small", "logger=none", "callbacks.learning_rate=null")


def write_experiments(folder: Path) -> None:
    """The stages of the package with small networks, images and steps, in a folder of one's own configs."""
    (folder / "experiment/small").mkdir(parents=True)
    for stage in STAGES:
        text = SMALL.format(stage=stage)
        if stage != "prior":
            text = text.replace("{level: 4, feature_channels: 4}", SIZES)
        if stage in ("finer", "longer", "further", "sharper", "clutter"):  # two steps of the refinement
            text = text.replace(
                "    4: {", "    7: {times: 0}\n    5: {seeds: [200, 1], times: 1, batch_size: 1}\n    4: {"
            )
            text = text.replace("    5: {times: 0}\n", "")
        (folder / f"experiment/small/{stage}.yaml").write_text(text)
    names = "".join(f"\n  small/{stage}: 0.01" for stage in STAGES)
    (folder / "experiment/small.yaml").write_text(
        f"# @package _global_\noutput: ${{paths.stages}}\nstages:{names}\n"
    )


def train(folder: Path, *words: str) -> None:
    """The command in a folder that has its own configs."""
    run_recipe(folder, "train", "--config-dir", "mine", *WORDS, *words)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which all stages have been trained without a stop."""
    folder = tmp_path_factory.mktemp("stages")
    write_experiments(folder / "mine")
    train(folder)
    return folder


@pytest.fixture
def started(done: Path, tmp_path: Path) -> Iterator[Path]:
    """The same as ``done``, of which the last stages have not begun."""
    folder = tmp_path / "again"
    shutil.copytree(done, folder)
    results = folder / "outputs/refinedsweepnet"
    for stage in LAST:
        shutil.rmtree(results / stage)
        (results / f"{stage}.safetensors").unlink()
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield folder
    for number, handler in before.items():
        signal.signal(number, handler)


def weights(folder: Path, stage: str) -> dict[str, torch.Tensor]:
    return load_weights(folder / f"outputs/refinedsweepnet/{stage}.safetensors").state_dict()


def test_each_stage_starts_from_the_one_before_and_learns_its_part(done: Path) -> None:
    prior, *others = (weights(done, stage) for stage in STAGES)
    assert all(torch.equal(value, others[0][f"prior.{name}"]) for name, value in prior.items())
    for stage, (before, after) in zip(STAGES[2:], pairwise(others), strict=True):
        parts, close = ("fusion", "refinement"), 0.0
        if (
            stage == "hints"
        ):  # starts from the mean of the three before; the largest tensors are kept as halves
            parts, close = ("fusion.hint_gate.exit",), 1e-3
            before = {name: torch.stack([each[name] for each in others[-4:-1]]).mean(0) for name in after}
        changed = {
            name
            for name, value in after.items()
            if not torch.allclose(value, before[name], close, 1e-4 * close)
        }
        assert changed
        assert all(name.startswith(parts) for name in changed)
    card = (done / "outputs/refinedsweepnet/hints.md").read_text()
    assert all(f"small/{stage}" in card for stage in STAGES)
    assert re.search(r"MAE \d+\.\d\d", card)
    hours = json.loads((done / "outputs/refinedsweepnet/hours.json").read_text())
    assert all(0 < hours[f"small/{stage}"] < 0.1 for stage in STAGES)


def test_a_stage_that_was_stopped_ends_with_the_same_weights(
    started: Path, done: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was rendered and computed before is made again where it is damaged."""
    step = DepthModule.training_step

    def interrupted(self: DepthModule, batch: Any, batch_idx: int) -> torch.Tensor:
        if self.global_step == 1 and not stopped:
            stopped.append(self.global_step)
            os.kill(os.getpid(), signal.SIGTERM)
        return step(self, batch, batch_idx)

    stopped: list[int] = []
    monkeypatch.setattr(DepthModule, "training_step", interrupted)
    with pytest.raises(SystemExit) as status:
        train(started)
    assert status.value.code == 143
    assert not (started / f"outputs/refinedsweepnet/{LAST[0]}.safetensors").exists()
    damaged = [*started.rglob("clues-*/*.npz")][:3] + [*started.rglob("samples-*/*.npz")][:3]
    for path in damaged:
        path.write_bytes(path.read_bytes()[:-100])
    train(started)
    for stage in LAST:
        result, expected = weights(started, stage), weights(done, stage)
        assert all(torch.equal(result[name], expected[name]) for name in expected)


def test_stages_that_are_done_are_skipped(done: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DepthModule, "training_step", None)
    train(done)


def test_a_stage_without_the_one_before_says_which_file_is_missing(failing: Run, tmp_path: Path) -> None:
    write_experiments(tmp_path / "mine")
    words = ("--config-dir", "mine", "experiment=small/coarse", *WORDS[1:])
    assert "prior.safetensors" in failing("train", *words)
    last = tmp_path / "mine/experiment/small/hints.yaml"  # which does not say when it is done
    last.write_text(re.sub("result: .*", "result: null", last.read_text()))
    assert "small/hints: this experiment sets no result=" in failing("train", "--config-dir", "mine", *WORDS)


def test_samples_larger_than_their_bound_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = "data.levels={5: {seeds: [0, 20]}, 6: {seeds: [100, 20]}}"
    config = composed(
        "train", "experiment=refinedsweepnet/prior", few, f"data.cache_dir={tmp_path}", "data.cache_gb=0.01"
    )
    data = build(config.data)
    data.bind_network(build(config.model))
    assert data.cache_bytes == 20 * (10_242 + 40_962) * (
        6 * (3 + 1) + 4
    )  # six cameras' colours and masks, and depth
    with pytest.raises(ArgumentError, match="cache_gb"):
        data.prepare_data()
    monkeypatch.setattr(shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(2, 1, 1))
    data.cache_gb = 100.0
    with pytest.raises(ArgumentError, match="cache_dir"):
        data.prepare_data()


def test_a_loss_from_clues_is_that_of_the_images(tmp_path: Path) -> None:
    """Half precision of the clues is all that differs, and the prior does not learn."""
    torch.manual_seed(0)
    prior = IcoSweepNet(
        3, 8, feature_channels=4, aggregation="variance", norm="instance", feature_coarsening=1
    )
    net = RefinedSweepNet.around(
        prior, level=4, coarse_level=2, widths=(4, 4), blocks=1, num_hypotheses=8, inner_hypotheses=8
    )
    weights = save_weights(net, tmp_path / "net.safetensors")
    assert isinstance(prior_of(weights), IcoSweepNet)
    config = composed("train", "data=random_rigs", "data.image_size=[16,16]", f"data.cache_dir={tmp_path}")
    levels = {4: {"seeds": [0, 2], "times": 1, "batch_size": 2, "image_size": [16, 16]}}
    losses = []
    for clues in (None, str(weights)):
        data = build(config.data, levels=levels, clues=clues, num_cameras=[4], augment=False)
        data.bind_network(net)
        batch = next(iter(data.train_dataloader()))
        losses.append(module_of(net).training_step(batch, 0))
    assert sum(2 * values[0].numel() for values in batch["clues"].values()) == clue_bytes(net, 4)
    torch.testing.assert_close(losses[1], losses[0], rtol=2e-3, atol=0)
    with pytest.raises(ArgumentError, match="IcoSweepNet"):
        SamplesWithClues(data.plain("train").of_level[4].samples, prior, prior, tmp_path)


def test_a_step_that_was_not_taken_begins_again_with_its_first_batch() -> None:
    """A checkpoint of a moment between the batches of a step counts those of whole steps alone."""
    module = module_of(IcoSweepNet(level=2, num_hypotheses=4, feature_channels=2))
    module._trainer = SimpleNamespace(accumulate_grad_batches=2)  # type: ignore[assignment]
    counts = {"ready": 7, "started": 7, "processed": 7, "completed": 6}
    progress = {"total": {**counts}, "current": {**counts}, "is_last_batch": False}
    checkpoint = {"global_step": 3, "loops": {"fit_loop": {"epoch_loop.batch_progress": progress}}}
    module.on_load_checkpoint(checkpoint)
    assert progress["total"] == progress["current"] == dict.fromkeys(counts, 6)
