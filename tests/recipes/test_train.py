# SPDX-License-Identifier: Apache-2.0
"""Training: it resumes exactly, saves what it says, and evaluation agrees with validation."""

from __future__ import annotations

import csv
import json
import signal
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from sphericalvision.core import ArgumentError
from sphericalvision.models import RefinedSweepNet, load_weights, save_weights
from sphericalvision.models.refinedsweepnet import PRIOR
from sphericalvision.recipes.app.checkpoints import initialize, load_network
from sphericalvision.recipes.datamodules.data_module import SampleDataModule, TrainingBatches, TrainingStream
from sphericalvision.recipes.training.depth_module import METRICS, DepthModule
from tests.recipes.tiny import Run, command_after

Words = tuple[str, ...]


def state(path: Path) -> dict[str, torch.Tensor]:
    return torch.load(path, weights_only=True)["state_dict"]


def test_resumed_training_equals_uninterrupted_training(
    run: Run, tmp_path: Path, tiny_training: Words, trained: Any
) -> None:
    last = trained.folder / "checkpoints/last.ckpt"
    run("train", *tiny_training, "trainer.max_steps=4", "output=straight")
    run("train", *tiny_training, "trainer.max_steps=4", "output=resumed", f"resume={last}")
    straight = state(tmp_path / "straight/checkpoints/last.ckpt")
    resumed = state(tmp_path / "resumed/checkpoints/last.ckpt")
    before = state(last)
    for name, value in straight.items():
        torch.testing.assert_close(resumed[name], value, rtol=0, atol=0, msg=name)
    assert any(not torch.equal(before[name], resumed[name]) for name in before)


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


def test_the_printed_resume_command_has_real_paths(trained: Any) -> None:
    program, *words = command_after(trained.printed, "Resume: ")
    assert program == "sphericalvision-train"
    assert f"output={trained.folder}" in words
    (resume,) = (word for word in words if word.startswith("resume="))
    assert Path(resume.removeprefix("resume=")).is_file()


def test_weights_beside_a_checkpoint_are_those_inside(trained: Any) -> None:
    beside = load_weights(trained.folder / "checkpoints/last.safetensors").state_dict()
    inside = load_network(trained.folder / "checkpoints/last.ckpt").state_dict()
    assert beside.keys() == inside.keys()
    assert all(torch.equal(beside[name], inside[name]) for name in beside)


def test_the_last_state_may_be_the_best_though_no_validation_falls_on_it(
    run: Run, tmp_path: Path, tiny_training: Words
) -> None:
    """Of the states after steps 2 and 3, one has the smaller error and the other the greater."""
    best_is_last = []
    for mode in ("min", "max"):
        words = "trainer.max_steps=3", "trainer.val_check_interval=2", f"task.mode={mode}", f"output={mode}"
        run("train", *tiny_training, *words)
        folder = tmp_path / mode / "checkpoints"
        best, last = (state(folder / f"{name}.ckpt") for name in ("best", "last"))
        best_is_last.append(all(torch.equal(best[name], last[name]) for name in last))
        beside = load_weights(folder / "best.safetensors").state_dict()
        assert all(torch.equal(value, best[f"net.{name}"]) for name, value in beside.items())
    assert sorted(best_is_last) == [False, True]


def test_of_averaged_weights_both_files_hold_the_average(
    run: Run, tmp_path: Path, tiny_training: Words
) -> None:
    run("train", *tiny_training, "trainer.max_steps=2", "callbacks=averaged", "output=averaged")
    folder = tmp_path / "averaged/checkpoints"
    (best,) = (state(path) for path in folder.glob("best.ckpt"))
    current = torch.load(folder / "best.ckpt", weights_only=True)["current_model_state"]
    beside = load_weights(folder / "best.safetensors").state_dict()
    assert all(torch.equal(value, best[f"net.{name}"]) for name, value in beside.items())
    assert any(not torch.equal(current[name], best[name]) for name in best)


def test_saved_hyperparameters_are_plain_scalars(trained: Any) -> None:
    stored = torch.load(trained.folder / "checkpoints/last.ckpt", weights_only=True)["hyper_parameters"]
    assert stored["level"] == 3
    assert all(isinstance(value, int | float | str | bool | None) for value in stored.values())


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
    with pytest.raises(ArgumentError, match=r"set model\.refining_colors=4 or take other weights$"):
        initialize(RefinedSweepNet(5, widths=(4, 4), blocks=1, refining_colors=3), weights)


def test_resuming_another_network_is_refused(
    failing: Callable[..., str], tiny_training: Words, trained: Any
) -> None:
    last = trained.folder / "checkpoints/last.ckpt"
    message = failing("train", *tiny_training, "model.level=4", f"resume={last}", "output=other")
    assert "level = 3" in message
    assert "model.level = 4" in message
    assert "init_weights=" in message


def test_an_interrupted_training_can_go_on(
    run: Run,
    tmp_path: Path,
    tiny_training: Words,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def interrupted_step(self: DepthModule, batch: Any, batch_idx: int) -> None:
        raise KeyboardInterrupt

    handler = signal.getsignal(signal.SIGINT)
    step = DepthModule.training_step
    with monkeypatch.context() as patch:
        patch.setattr(
            DepthModule, "training_step", lambda *x: (step if x[0].global_step < 2 else interrupted_step)(*x)
        )
        with pytest.raises(SystemExit):
            run("train", *tiny_training, "trainer.max_steps=4", "output=run")
    signal.signal(signal.SIGINT, handler)
    program, *words = command_after(capsys.readouterr().out, "sphericalvision-train ")
    run("train", program, *words)
    checkpoint = torch.load(tmp_path / "run/checkpoints/last.ckpt", weights_only=True)
    assert checkpoint["global_step"] == 4


def test_a_training_stream_is_a_function_of_seed_and_position() -> None:
    """Every round holds each sample once; a stream that starts later is the same stream, noise included."""

    class Noisy(torch.utils.data.Dataset[dict[str, Any]]):
        def __len__(self) -> int:
            return 5

        def __getitem__(self, index: int) -> dict[str, Any]:
            return {"index": index, "noise": torch.rand(())}

    stream = TrainingStream(Noisy(), seed=3)
    whole = [stream[i] for i in range(15)]
    for start in (0, 5, 10):
        assert sorted(sample["index"] for sample in whole[start : start + 5]) == [0, 1, 2, 3, 4]
    assert [sample["index"] for sample in whole[:5]] != [sample["index"] for sample in whole[5:10]]
    later = TrainingBatches(stream, batch_size=1, length=8, start=7)
    assert [stream[i] for (i,) in later] == whole[7:]
    other = TrainingStream(Noisy(), seed=4)
    assert [other[i]["noise"] for i in range(5)] != [sample["noise"] for sample in whole[:5]]


def test_batches_seen_are_those_of_all_processes() -> None:
    module = SimpleNamespace(trainer=SimpleNamespace(global_step=5, accumulate_grad_batches=2, world_size=4))
    assert SampleDataModule.state_dict(module) == {"batches_seen": 5 * 2 * 4}  # type: ignore[arg-type]
