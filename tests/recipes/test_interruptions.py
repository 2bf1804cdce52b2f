# SPDX-License-Identifier: Apache-2.0
"""Interruptions: nothing that was learned is lost, nothing is half written, and shells are told."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from pytorch_lightning.plugins.io import TorchCheckpointIO

from sphericalvision.models import IcoSweepNet
from sphericalvision.recipes.app.command import Command
from sphericalvision.recipes.training.depth_module import DepthModule
from sphericalvision.recipes.training.run_folder import WeightsBesideCheckpoint
from tests.recipes.tiny import Run

Words = tuple[str, ...]


@pytest.fixture
def signals() -> Iterator[None]:
    """Python's own handlers, left out where a background shell ignores Ctrl-C; as before afterwards."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_an_interrupt_while_a_command_imports_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Interrupt:
        """Ctrl-C as soon as the first heavy module is looked for."""

        def find_spec(self, name: str, *args: Any) -> None:
            if name == "sphericalvision.recipes.app.running":
                raise KeyboardInterrupt

    monkeypatch.delitem(sys.modules, "sphericalvision.recipes.app.running", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Interrupt(), *sys.meta_path])
    with pytest.raises(SystemExit) as stopped:
        Command("predict")([])
    assert (stopped.value.code, capsys.readouterr().err) == (130, "\nInterrupted.\n")


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_saves_what_was_learned_and_is_the_exit_status(
    run: Run,
    tmp_path: Path,
    tiny_training: Words,
    monkeypatch: pytest.MonkeyPatch,
    signals: None,
    number: signal.Signals,
    status: int,
) -> None:
    step = DepthModule.training_step

    def interrupted(self: DepthModule, batch: Any, batch_idx: int) -> torch.Tensor:
        if self.global_step == 2:
            os.kill(os.getpid(), number)
        return step(self, batch, batch_idx)

    monkeypatch.setattr(DepthModule, "training_step", interrupted)
    with pytest.raises(SystemExit) as stopped:
        run("train", *tiny_training, "trainer.max_steps=9", "trainer.val_check_interval=9", "output=run")
    assert stopped.value.code == status
    stored = torch.load(tmp_path / "run/checkpoints/last.ckpt", weights_only=True)
    assert 2 <= stored["global_step"] <= 3


@pytest.mark.slow
def test_accumulated_batches_are_counted_when_training_goes_on(
    run: Run, tmp_path: Path, tiny_training: Words
) -> None:
    words = (*tiny_training, "trainer.accumulate_grad_batches=2", "data.batch_size=1", "logger=none")
    run("train", *words, "trainer.max_steps=2", "output=straight")
    run("train", *words, "trainer.max_steps=1", "output=first")
    last = tmp_path / "first/checkpoints/last.ckpt"
    run("train", *words, "trainer.max_steps=2", "output=resumed", f"resume={last}")
    straight, resumed = (
        torch.load(tmp_path / name / "checkpoints/last.ckpt", weights_only=True)["state_dict"]
        for name in ("straight", "resumed")
    )
    for name, value in straight.items():
        torch.testing.assert_close(resumed[name], value, rtol=0, atol=0, msg=name)


def test_a_checkpoint_appears_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that fills up while a checkpoint is written leaves the previous one, and the weights beside it."""
    net = IcoSweepNet(level=3, num_hypotheses=4, feature_channels=2)
    io, path = WeightsBesideCheckpoint(net), tmp_path / "last.ckpt"
    io.save_checkpoint({"global_step": 1}, path)
    weights = path.with_suffix(".safetensors").read_bytes()

    def half(self: Any, checkpoint: Any, path: Any, storage_options: Any = None) -> None:
        Path(path).write_bytes(b"PK half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(TorchCheckpointIO, "save_checkpoint", half)
    with pytest.raises(OSError, match="No space left"):
        io.save_checkpoint({"global_step": 2}, path)
    assert torch.load(path, weights_only=True)["global_step"] == 1
    assert path.with_suffix(".safetensors").read_bytes() == weights
