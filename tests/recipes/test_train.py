# SPDX-License-Identifier: Apache-2.0
"""Training: it saves what it says, stops and resumes exactly, and evaluation agrees with validation."""

from __future__ import annotations

import csv
import errno
import json
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from pytorch_lightning.plugins.io import TorchCheckpointIO

from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.models import IcoSweepNet, RefinedSweepNet, load_weights, save_weights
from sphericalvision.models.refinedsweepnet import PRIOR
from sphericalvision.models.weights.checkpoints import read_network
from sphericalvision.recipes.app.checkpoints import initialize
from sphericalvision.recipes.app.command import Command
from sphericalvision.recipes.app.errors import plain_errors
from sphericalvision.recipes.training.depth_module import METRICS, DepthModule
from sphericalvision.recipes.training.run_folder import (
    WeightsBesideCheckpoint,
    changed_settings,
    resume_path,
    run_folder,
    stored_network,
)
from tests.recipes.tiny import Run, command_after

Words = tuple[str, ...]
LAST = "checkpoints/last.ckpt"


def stored(folder: Path, name: str = "last") -> dict[str, Any]:
    """The content of a checkpoint of a run."""
    return torch.load(folder / f"checkpoints/{name}.ckpt", weights_only=True)


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether the states of two checkpoints are equal to the last bit."""
    states = one["state_dict"], other["state_dict"]
    return all(torch.equal(states[1][name], value) for name, value in states[0].items())


def dying(monkeypatch: pytest.MonkeyPatch, last: int, die: Callable[[], None]) -> None:
    """Let trainings die in their step after ``last``."""
    step = DepthModule.training_step

    def training_step(self: DepthModule, batch: Any, batch_idx: int) -> torch.Tensor:
        if self.global_step == last:
            die()
        return step(self, batch, batch_idx)

    monkeypatch.setattr(DepthModule, "training_step", training_step)


@pytest.mark.parametrize(
    "more",
    [(), pytest.param(("trainer.accumulate_grad_batches=2", "data.batch_size=1"), marks=pytest.mark.slow)],
)
def test_resumed_training_equals_uninterrupted_training(
    run: Run, tmp_path: Path, tiny_training: Words, trained: Any, more: Words
) -> None:
    words, first = (*tiny_training, *more), trained.folder
    if more:
        first = tmp_path / "first"
        run("train", *words, "trainer.max_steps=2", "output=first")
    run("train", *words, "trainer.max_steps=4", "output=straight")
    run("train", *words, "trainer.max_steps=4", "output=resumed", f"resume={first / LAST}")
    straight, resumed = stored(tmp_path / "straight"), stored(tmp_path / "resumed")
    assert same(straight, resumed)
    assert not same(stored(first), resumed)


def test_training_in_mixed_precision_stays_close(
    run: Run, tmp_path: Path, tiny_training: Words, trained: Any
) -> None:
    run("train", *tiny_training, "trainer.max_steps=2", "trainer.precision=bf16-mixed", "output=mixed")
    single, mixed = (
        json.loads((folder / "validation.json").read_text())
        for folder in (trained.folder, tmp_path / "mixed")
    )
    ((single_errors,), (mixed_errors,)) = single.values(), mixed.values()
    assert mixed_errors == pytest.approx(single_errors, rel=0.1)
    assert mixed_errors != single_errors


def test_everything_is_in_one_folder(trained: Any) -> None:
    folder = trained.folder
    assert OmegaConf.load(folder / "config.yaml").model.level == 3
    names = {f"{name}.{suffix}" for name in ("best", "last") for suffix in ("ckpt", "safetensors")}
    assert {path.name for path in (folder / "checkpoints").iterdir()} == names
    assert sorted(path.name for path in (folder / "panels").iterdir()) == ["000001.png", "000002.png"]
    assert list((folder / "tensorboard").glob("events*"))
    (metrics,) = (folder / "metrics").glob("*/metrics.csv")
    logged = [float(row["val/MAE"]) for row in csv.DictReader(metrics.open()) if row["val/MAE"]]
    (validated,) = json.loads((folder / "validation.json").read_text()).values()
    assert validated["MAE"] == pytest.approx(min(logged))
    parameters = stored(folder)["hyper_parameters"]
    assert parameters["level"] == 3
    assert all(isinstance(value, int | float | str | bool | None) for value in parameters.values())


def test_evaluation_equals_validation(run: Run, tmp_path: Path, trained: Any) -> None:
    """The evaluate command that training prints gives the numbers that training validated."""
    (validated,) = json.loads((trained.folder / "validation.json").read_text()).values()
    program, *words = command_after(trained.printed, "Evaluate: ")
    assert program == "sphericalvision-evaluate"
    run("evaluate", *words, "split=val", "output=table", "device=cpu")
    (evaluated,) = json.loads((tmp_path / "table/metrics.json").read_text()).values()
    assert list(evaluated) == [*METRICS, "AbsRel", "d<1.25"]
    assert {name: evaluated[name] for name in METRICS} == pytest.approx(validated, abs=1e-4)
    assert (tmp_path / "table/metrics.md").read_text().startswith("| | >1 | >3 | >5 | MAE | RMS |")
    assert "val, 2 frame(s), level " in (tmp_path / "table/metrics.md").read_text()
    assert r"& $>$5 & MAE & RMS & AbsRel & " in (tmp_path / "table/metrics.tex").read_text()


def test_the_last_state_may_be_the_best_though_no_validation_falls_on_it(
    run: Run, tmp_path: Path, tiny_training: Words
) -> None:
    """Of the states after steps 2 and 3, one has the smaller error and the other the greater."""
    best_is_last = []
    for mode in ("min", "max"):
        words = "trainer.max_steps=3", "trainer.val_check_interval=2", f"task.mode={mode}", f"output={mode}"
        run("train", *tiny_training, *words)
        best, last = (stored(tmp_path / mode, name) for name in ("best", "last"))
        best_is_last.append(same(best, last))
        beside = load_weights(tmp_path / mode / "checkpoints/best.safetensors").state_dict()
        assert all(torch.equal(value, best["state_dict"][f"net.{name}"]) for name, value in beside.items())
    assert sorted(best_is_last) == [False, True]


def test_of_averaged_weights_both_files_hold_the_average(
    run: Run, tmp_path: Path, tiny_training: Words
) -> None:
    run("train", *tiny_training, "trainer.max_steps=2", "callbacks=averaged", "output=averaged")
    best = stored(tmp_path / "averaged", "best")
    beside = load_weights(tmp_path / "averaged/checkpoints/best.safetensors").state_dict()
    assert all(torch.equal(value, best["state_dict"][f"net.{name}"]) for name, value in beside.items())
    assert not same(best, {"state_dict": best["current_model_state"]})


def test_training_starts_from_weights_of_another_level(
    run: Run, tmp_path: Path, weights: Path, tiny_training: Words
) -> None:
    still = ("model.level=4", "trainer.max_steps=1", "optimizer.lr=0.0")
    run("train", *tiny_training, *still, "output=run", f"init_weights={weights}")
    after = load_weights(tmp_path / "run/checkpoints/last.safetensors")
    assert after.hyperparameters["level"] == 4
    for name, value in load_weights(weights).named_parameters():
        assert torch.equal(after.get_parameter(name), value), name


def test_weights_of_other_sizes_are_refused_by_what_differs(tmp_path: Path) -> None:
    weights = tmp_path / "other.safetensors"
    save_weights(RefinedSweepNet(5, widths=(4, 4), blocks=1, prior={**PRIOR}), weights)
    with pytest.raises(ArgumentError, match=r"set model\.refining_blocks=2 or take other weights$"):
        initialize(RefinedSweepNet(5, min_depth=0.7, widths=(4, 4), blocks=1, refining_blocks=1), weights)


def test_resuming_another_network_is_refused(failing: Run, tiny_training: Words, trained: Any) -> None:
    words = ("model.level=4", f"resume={trained.folder / LAST}", "output=other")
    assert "model.level = 4" in failing("train", *tiny_training, *words)


def hold(folder: Path, holding: Any, done: Any) -> None:
    """Keep a folder until told to stop."""
    with run_folder(folder):
        holding.set()
        done.wait(60)


def test_a_mean_of_weights_needs_those_to_start_from(failing: Run, tiny_training: Words) -> None:
    message = failing("train", *tiny_training, "task.mean_with=[refinedsweepnet]")
    assert "set init_weights=" in message


def test_one_training_at_a_time(tmp_path: Path) -> None:
    """The lock goes with the process that holds it, even where that is killed."""
    context = multiprocessing.get_context("fork")
    holding, done = context.Event(), context.Event()
    other = context.Process(target=hold, args=(tmp_path, holding, done))
    other.start()
    assert holding.wait(60)
    with pytest.raises(ArgumentError, match=f"process {other.pid} on "), run_folder(tmp_path):
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
        (folder / LAST).touch()
    last = run / LAST
    assert resume_path("auto", run) == resume_path(str(last), run) == last
    for resume in (None, str(other / LAST)):
        with pytest.raises(ArgumentError, match=r"resume=auto"):
            resume_path(resume, run)
    assert resume_path(str(last), tmp_path / "new") == last
    last.rename(last.with_name("best.ckpt"))
    assert resume_path("auto", run) == last.with_name("best.ckpt")


def test_last_is_written_at_each_validation_and_best_goes_on_without_it(
    run: Run, tmp_path: Path, tiny_training: Words, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that was killed after a validation has both; with the last one gone, the best is gone on from."""
    words = (*tiny_training, "logger=none", "trainer.val_check_interval=2", "trainer.max_steps=4")

    def killed() -> None:
        raise RuntimeError("killed")

    with monkeypatch.context() as patch:
        dying(patch, 3, killed)
        with pytest.raises(RuntimeError, match="killed"):
            run("train", *words, "output=run")
    last, best = (stored(tmp_path / "run", name) for name in ("last", "best"))
    assert last["global_step"] == best["global_step"] == 2
    paths = [s["best_model_path"] for name, s in last["callbacks"].items() if "'monitor': 'val" in name]
    assert paths == [str(tmp_path / "run/checkpoints/best.ckpt")]
    (tmp_path / "run" / LAST).unlink()
    run("train", *words, "output=run", "resume=auto")
    run("train", *words, "output=straight")
    assert same(stored(tmp_path / "straight"), stored(tmp_path / "run"))


def test_a_finished_training_is_not_overwritten(
    failing: Run, run: Run, tmp_path: Path, tiny_training: Words
) -> None:
    words = (*tiny_training, "callbacks=none", "logger=none", "output=run")
    run("train", *words, "trainer.max_steps=2")
    before = (tmp_path / "run" / LAST).read_bytes()
    failing("train", *words, "trainer.max_steps=1")
    assert (tmp_path / "run" / LAST).read_bytes() == before
    printed = run("train", *words, "trainer.max_steps=3", "resume=auto", "seed=1")
    assert "trainer.max_steps was 2, is 3" in printed
    assert " seed was 0, is 1" in printed
    assert stored(tmp_path / "run")["global_step"] == 3


def test_a_folder_that_moved_has_the_same_settings(tmp_path: Path) -> None:
    old = {"paths": {"run": "/old/run"}, "logger": {"save_dir": "/old/run/logs"}, "data": {"root": "/data/a"}}
    (tmp_path / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(old)))
    new = {"paths": {"run": "/new"}, "logger": {"save_dir": "/new/logs"}, "data": {"root": "/data/b"}}
    changes = changed_settings(tmp_path, OmegaConf.create(new))
    assert changes == ["data.root was /data/a, is /data/b"]


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
    capsys: pytest.CaptureFixture[str],
    signals: None,
    number: signal.Signals,
    status: int,
) -> None:
    """And the command that is printed goes on to the end."""
    words = (*tiny_training, "trainer.max_steps=4", "trainer.val_check_interval=4", "output=run")
    with monkeypatch.context() as patch:
        dying(patch, 2, lambda: os.kill(os.getpid(), number))
        with pytest.raises(SystemExit) as stopped:
            run("train", *words)
    assert stopped.value.code == status
    assert 2 <= stored(tmp_path / "run")["global_step"] <= 3
    signal.signal(signal.SIGINT, signal.default_int_handler)  # which Lightning ignores once it has stopped
    run("train", *command_after(capsys.readouterr().out, "sphericalvision-train "))
    assert stored(tmp_path / "run")["global_step"] == 4


def test_a_checkpoint_appears_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that fills up while a checkpoint is written leaves the previous one, and the weights beside it."""
    net = IcoSweepNet(level=3, num_hypotheses=4, feature_channels=2)
    io, path = WeightsBesideCheckpoint(net), tmp_path / "last.ckpt"
    io.save_checkpoint({"global_step": 1}, path)
    weights = path.with_suffix(".safetensors").read_bytes()

    def half(self: Any, checkpoint: Any, path: Any, storage_options: Any = None) -> None:
        Path(path).write_bytes(b"PK half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(TorchCheckpointIO, "save_checkpoint", half)
    with pytest.raises(OSError, match="No space left"):
        io.save_checkpoint({"global_step": 2}, path)
    assert torch.load(path, weights_only=True)["global_step"] == 1
    assert path.with_suffix(".safetensors").read_bytes() == weights


DAMAGES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "a list": lambda content: [content],
    "nothing": lambda content: None,
    "no state": lambda content: {**content, "state_dict": None},
    "no hyper-parameters": lambda content: {**content, "network_hyperparameters": None},
    "other hyper-parameters": lambda content: {**content, "network_hyperparameters": {"depth": 3}},
    "an unknown network": lambda content: {**content, "architecture": "nobody"},
    "not numbers": lambda content: {
        **content,
        "state_dict": {
            key: torch.full_like(value, torch.nan) for key, value in content["state_dict"].items()
        },
    },
    **{
        key: lambda content, key=key: {k: value for k, value in content.items() if k != key}
        for key in ("optimizer_states", "loops", "global_step")
    },
}
"""What is wrong -> what becomes of a checkpoint."""
PREDICTION = {"no hyper-parameters", "other hyper-parameters", "an unknown network"}
"""Damages to prediction alone: resuming compares hyper-parameters with those of the run."""
RESUMING = {"optimizer_states", "loops", "global_step"}
"""To resuming alone: there are weights."""


@pytest.mark.parametrize("damage", [*DAMAGES, 0, 1, 100, 5000])
def test_damaged_and_cut_checkpoints_are_refused(trained: Any, tmp_path: Path, damage: str | int) -> None:
    path = tmp_path / "damaged.ckpt"
    if isinstance(damage, int):
        path.write_bytes((trained.folder / LAST).read_bytes()[:damage])
    else:
        torch.save(DAMAGES[damage](stored(trained.folder)), path)
    if damage not in RESUMING:
        with pytest.raises(FileFormatError, match=r"damaged\.ckpt"):
            read_network(path)
    if damage not in PREDICTION:
        with pytest.raises(FileFormatError, match=str(damage) if damage in RESUMING else r"damaged\.ckpt"):
            stored_network(path)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.ENOTDIR])
def test_what_the_disk_refuses_is_one_paragraph(number: int, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped, plain_errors():
        raise OSError(number, "what the system says", "/somewhere/x.png")
    assert stopped.value.code == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("Error: /somewhere/x.png: what the system says; ")
