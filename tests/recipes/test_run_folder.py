# SPDX-License-Identifier: Apache-2.0
"""The folder of a run: a finished training is not overwritten, two do not share it, and changes are told."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from sphericalvision.core import ArgumentError
from sphericalvision.recipes.training.depth_module import DepthModule
from sphericalvision.recipes.training.run_folder import changed_settings, resume_path, run_folder
from tests.recipes.tiny import Run

Words = tuple[str, ...]


def hold(folder: Path, holding: Any, done: Any) -> None:
    """Keep a folder until told to stop."""
    with run_folder(folder):
        holding.set()
        done.wait(60)


def test_one_training_at_a_time(tmp_path: Path) -> None:
    """The lock goes with the process that holds it, even where that is killed."""
    context = multiprocessing.get_context("fork")
    holding, done = context.Event(), context.Event()
    other = context.Process(target=hold, args=(tmp_path, holding, done))
    other.start()
    assert holding.wait(60)
    with (
        pytest.raises(ArgumentError, match=f"at work in .* \\(process {other.pid} on "),
        run_folder(tmp_path),
    ):
        pass
    other.kill()
    other.join()
    with run_folder(tmp_path):
        pass


def test_what_a_folder_holds_decides_what_resume_may_be(tmp_path: Path) -> None:
    run, other = tmp_path / "run", tmp_path / "other"
    assert resume_path(None, run) is None
    assert resume_path("auto", run) is None
    for folder in (run, other):
        (folder / "checkpoints").mkdir(parents=True)
        (folder / "checkpoints/last.ckpt").touch()
    last = run / "checkpoints/last.ckpt"
    assert resume_path("auto", run) == resume_path(str(last), run) == last
    for resume in (None, str(other / "checkpoints/last.ckpt")):
        with pytest.raises(ArgumentError, match=r"holds a training already.*resume=auto"):
            resume_path(resume, run)
    assert resume_path(str(last), tmp_path / "new") == last
    last.rename(last.with_name("best.ckpt"))
    assert resume_path("auto", run) == last.with_name("best.ckpt")


def test_last_is_written_at_each_validation_and_best_goes_on_without_it(
    run: Run, tmp_path: Path, tiny_training: Words, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    """A run that was killed after a validation has both; with the last one gone, the best is gone on from."""
    words = (
        *tiny_training,
        "logger=none",
        "output=run",
        "trainer.val_check_interval=2",
        "trainer.max_steps=4",
    )
    step, checkpoints = DepthModule.training_step, tmp_path / "run/checkpoints"

    def killed(self: DepthModule, batch: Any, batch_idx: int) -> torch.Tensor:
        if self.global_step == 3:
            raise RuntimeError("killed")
        return step(self, batch, batch_idx)

    monkeypatch.setattr(DepthModule, "training_step", killed)
    with pytest.raises(RuntimeError, match="killed"):
        run("train", *words)
    monkeypatch.undo()
    stored = [torch.load(checkpoints / name, weights_only=True) for name in ("last.ckpt", "best.ckpt")]
    assert [content["global_step"] for content in stored] == [2, 2]
    paths = [
        state["best_model_path"]
        for name, state in stored[0]["callbacks"].items()
        if "'monitor': 'val" in name
    ]
    assert paths == [str(checkpoints / "best.ckpt")]
    (checkpoints / "last.ckpt").unlink()
    run("train", *words, "resume=auto")
    assert "best.ckpt" in capsys.readouterr().out
    resumed = torch.load(checkpoints / "last.ckpt", weights_only=True)["state_dict"]
    run("train", *(word for word in words if word != "output=run"), "output=straight")
    straight = torch.load(tmp_path / "straight/checkpoints/last.ckpt", weights_only=True)["state_dict"]
    assert all(torch.equal(resumed[name], value) for name, value in straight.items())


def test_a_finished_training_is_not_overwritten(
    failing: Callable[..., str], run: Run, tmp_path: Path, tiny_training: Words, capsys: Any
) -> None:
    words = (*tiny_training, "callbacks=none", "logger=none", "output=run")
    run("train", *words, "trainer.max_steps=2")
    before = (tmp_path / "run/checkpoints/last.ckpt").read_bytes()
    assert "holds a training already" in failing("train", *words, "trainer.max_steps=1")
    assert (tmp_path / "run/checkpoints/last.ckpt").read_bytes() == before
    capsys.readouterr()
    run("train", *words, "trainer.max_steps=3", "resume=auto", "seed=1")
    printed = capsys.readouterr().out
    assert "trainer.max_steps was 2, is 3" in printed
    assert " seed was 0, is 1" in printed
    assert torch.load(tmp_path / "run/checkpoints/last.ckpt", weights_only=True)["global_step"] == 3


def test_a_folder_that_moved_has_the_same_settings(tmp_path: Path) -> None:
    old = {"paths": {"run": "/old/run"}, "logger": {"save_dir": "/old/run/logs"}, "data": {"root": "/data/a"}}
    (tmp_path / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(old)))
    new = {"paths": {"run": "/new"}, "logger": {"save_dir": "/new/logs"}, "data": {"root": "/data/b"}}
    changes = changed_settings(tmp_path, OmegaConf.create(new))
    assert changes == ["data.root was /data/a, is /data/b"]
