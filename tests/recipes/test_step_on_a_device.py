# SPDX-License-Identifier: Apache-2.0
"""A training step on a device: few operators, none of which the host waits for, counted on a CPU."""

from __future__ import annotations

import re
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
import pytorch_lightning as pl
import torch

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.graphs import NoWaiting
from sphericalvision.icosphere import num_icosphere_vertices
from sphericalvision.kernels import kernels
from sphericalvision.losses import depth_index_huber
from sphericalvision.models import RefinedSweepNet
from sphericalvision.models.refinedsweepnet import PRIOR
from sphericalvision.recipes.training import callbacks
from sphericalvision.recipes.training.callbacks import MovingAverage
from sphericalvision.recipes.training.depth_module import DepthModule
from sphericalvision.scenes.random_rigs import random_rig
from tests.models.test_one_graph import Operators

LEVEL, BATCH, CAMERAS = 3, 2, 2
OPERATORS = {"tables": 274, "loss": 1448, "backward": 1039, "update": 11}
"""Without views, of each part at most, for any channels, batches and images. On a GPU with Triton the smoothing of the
sweep is one of them."""


@pytest.fixture(scope="module")
def module() -> DepthModule:
    """The network of ``model=refinedsweepnet`` with fewer channels, levels and blocks."""
    torch.manual_seed(0)
    net = RefinedSweepNet(
        LEVEL,
        widths=(4,) * 3,
        blocks=1,
        prior={**PRIOR, "feature_channels": 4},
    )
    adamw = partial(torch.optim.AdamW, foreach=True)  # as it is by itself on a GPU
    module = DepthModule(net.train(), depth_index_huber, adamw, lambda optimizer: optimizer)
    module.log = unread  # type: ignore[method-assign,assignment]
    return module


def unread(*_: Any, prog_bar: bool = False, **__: Any) -> None:
    assert not prog_bar, "Lightning reads values for a bar back at every step"


def batch() -> dict[str, Any]:
    generator = torch.Generator().manual_seed(0)
    size = (BATCH, CAMERAS, num_icosphere_vertices(LEVEL))
    rigs = [random_rig(generator, (CAMERAS,), image_size=(16, 16), panoramas=0.0) for _ in range(BATCH)]
    return {
        "images": torch.randint(255, (BATCH, CAMERAS, 3, size[-1]), generator=generator, dtype=torch.uint8),
        "seen": torch.rand(size, generator=generator) < 0.9,
        "inverse_depth": torch.rand(size[::2], generator=generator),
        "valid": torch.rand(size[::2], generator=generator) < 0.9,
        "rig": CameraRig.stack(rigs),
    }


def averaging(
    module: pl.LightningModule, device: str = "cpu", decay: float = 0.5
) -> tuple[MovingAverage, Any]:
    trainer: Any = SimpleNamespace(global_step=0, strategy=SimpleNamespace(root_device=torch.device(device)))
    average = MovingAverage(decay)
    average.setup(trainer, module, "fit")
    return average, trainer


def test_a_training_step_is_few_operators_without_a_word_to_the_host(module: DepthModule) -> None:
    sample, weights = batch(), list(module.net.parameters())
    optimizer: torch.optim.Optimizer = module.make_optimizer(weights)
    average, trainer = averaging(module)
    counts = {}
    with kernels("graph"):
        for step in (1, 2):  # the first makes the tables of icospheres
            trainer.global_step = step
            with NoWaiting(), Operators() as tables:
                rig = module.net.tables(sample["rig"])
            module.tables.of = lambda _, rig=rig: rig  # type: ignore[method-assign,misc]
            module.on_train_batch_start(sample, step)
            with NoWaiting(), Operators() as forward:
                loss = module.training_step(sample, step)
            with NoWaiting(), Operators() as backward:
                loss.backward()
            with NoWaiting(), Operators() as update:
                module.on_before_optimizer_step(optimizer)
                torch.nn.utils.clip_grad_norm_(weights, 1.0, foreach=True)
            optimizer.step()  # counts its steps on the host
            with NoWaiting(), Operators() as averaged:
                average.on_train_batch_end(trainer, module, None, sample, step)
            optimizer.zero_grad()
            counts = {
                "tables": tables.launches,
                "loss": forward.launches,
                "backward": backward.launches,
                "update": update.launches + averaged.launches,
            }
    print(counts)  # pytest -s
    for part, most in OPERATORS.items():
        assert counts[part] <= most, part


def test_the_average_is_where_the_weights_will_be(module: DepthModule) -> None:
    average, _ = averaging(module, "meta")
    assert average._average_model is not None
    assert all(value.is_meta for value in average._average_model.module.state_dict().values())


def test_the_average_keeps_the_share_of_its_decay_at_each_step() -> None:
    module, expected = pl.LightningModule(), 0.0
    module.layer = torch.nn.Linear(2, 2)
    average, trainer = averaging(module, decay=0.9)
    for step, value in enumerate((1.0, 3.0, -2.0), start=1):
        for weight in module.parameters():
            torch.nn.init.constant_(weight, value)
        trainer.global_step = step
        for _ in range(2):  # gradients of two batches make a step
            average.on_train_batch_end(trainer, module, None, None, step)
        expected = 0.9 * expected + 0.1 * value if step > 1 else value
        assert average._average_model is not None
        for weight in average._average_model.module.parameters():
            torch.testing.assert_close(weight.detach(), torch.full_like(weight, expected))


def test_a_gradient_that_is_no_number_is_left_out(module: DepthModule) -> None:
    weights = list(module.net.parameters())
    for weight in weights:
        weight.grad = torch.ones_like(weight)
    weights[0].grad[0], weights[-1].grad[..., -1] = torch.nan, torch.inf  # type: ignore[index]
    module.on_before_optimizer_step(torch.optim.SGD(weights))
    total = sum(weight.grad.sum().item() for weight in weights if weight.grad is not None)
    assert total == sum(map(torch.numel, weights)) - weights[0][0].numel() - weights[-1][..., -1].numel()
    module.net.zero_grad()


def test_a_line_of_progress_tells_where_a_training_stands(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Gone on at step 4; of thirty seconds for two steps ten were waited for samples."""
    clock = iter([100.0, 104.0, 110.0, 116.0, 130.0])
    monkeypatch.setattr(callbacks, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    trainer: Any = SimpleNamespace(global_step=4, max_steps=20, is_global_zero=True)
    trainer.callback_metrics = {"train/loss": torch.tensor(0.25)}
    progress = callbacks.PlainProgress()
    progress.on_train_start(trainer, None)  # type: ignore[arg-type]
    for trainer.global_step in (5, 6):
        progress.on_train_batch_start(trainer)
        progress.on_train_batch_end(trainer)
    numbers = re.findall(r"\d[\d.:]*", capsys.readouterr().out)
    assert numbers == ["6", "20", "0:03:30", "15.00", "33", "0.250"]


def test_a_bar_shows_the_loss_of_every_tenth_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(callbacks.RichProgressBar, "get_metrics", lambda *_: {})
    bar, shown = callbacks.TrainingBar(), []
    for step in (3, 4, 10, 11):
        trainer: Any = SimpleNamespace(global_step=step, callback_metrics={"train/loss": torch.tensor(step)})
        shown += bar.get_metrics(trainer, None).values()  # type: ignore[arg-type]
    assert shown == [3, 3, 10, 10]
