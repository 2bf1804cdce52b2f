# SPDX-License-Identifier: Apache-2.0
"""What people look for in a recipe: loggers, sweeps, short runs that find mistakes; each by one documented word."""

from __future__ import annotations

import json
import math
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf
from pytorch_lightning.loggers import CSVLogger

from sphericalvision.core import ArgumentError
from sphericalvision.models import load_weights
from sphericalvision.models.weights.checkpoints import read_network
from sphericalvision.recipes.app.cli import build
from sphericalvision.recipes.app.multirun_table import multirun_rows
from sphericalvision.recipes.app.own_files import import_own_files
from sphericalvision.recipes.evaluation.records import write_json
from tests.recipes.tiny import TINY_SCENES, Run, composed, typed

Words = tuple[str, ...]


@pytest.mark.parametrize(
    "word", typed("rig=equirect4 scheduler=step scheduler=one_cycle model=omnimvs_small optimizer=sgd")
)
def test_another_option_takes_the_place_of_the_experiments(word: str) -> None:
    """Nothing that belongs to one rig or schedule stays when another is chosen."""
    group = word.partition("=")[0]
    assert build(composed("train", "experiment=quickstart", word)[group], group) is not None


def test_a_sweep_ends_with_a_table(run: Run, tmp_path: Path, tiny_training: Words) -> None:
    words = ("trainer.max_steps=1", "hparams=learning_rate", "logger=none", "output=sweep")
    printed = run("train", *tiny_training, *words)
    rows = json.loads((tmp_path / "sweep/sweep.json").read_text())
    assert [row["optimizer.lr"] for row in rows] == ["0.0005", "0.002"]
    assert all(math.isfinite(row["MAE"]) for row in rows)
    assert "| run | optimizer.lr | >1 |" in (tmp_path / "sweep/sweep.md").read_text()
    lines = [line for line in printed.splitlines() if line.startswith("Resume:")]
    program, *resumed = shlex.split(lines[-1].removeprefix("Resume:"))
    assert program == "sphericalvision-train"
    run("train", *resumed)  # as pasted: goes on with that run, and sweeps no more
    assert len(list((tmp_path / "sweep").glob("*/validation.json"))) == 2
    assert "step 2" in (tmp_path / "sweep/1/validation.md").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["joblib", "submitit"])
def test_the_runs_of_a_sweep_go_where_the_launcher_says(
    run: Run, tmp_path: Path, tiny_training: Words, launcher: str
) -> None:
    pytest.importorskip(f"hydra_plugins.hydra_{launcher}_launcher")
    here = ["hydra/launcher=submitit_local"] if launcher == "submitit" else []
    short = ("trainer.max_steps=1", "logger=none", "callbacks=none", "output=sweep")
    run("train", *tiny_training, "hparams=learning_rate", f"launcher={launcher}", *here, *short)
    rows = json.loads((tmp_path / "sweep/sweep.json").read_text())
    assert [row["optimizer.lr"] for row in rows] == ["0.0005", "0.002"]
    assert (tmp_path / "sweep/.submitit").is_dir() == (launcher == "submitit")


OWN_NETWORK = """
from sphericalvision.models import IcoSweepNet, register_network


class Squashed(IcoSweepNet):
    def __init__(self, level=7, num_hypotheses=32, feature_channels=32, squash=1.0):
        super().__init__(level, num_hypotheses, feature_channels=feature_channels, norm="instance")
        self.squash = squash

    def extract_features(self, images):
        return super().extract_features((self.squash * images).tanh())


register_network("squashed", Squashed)
"""


def test_a_network_of_ones_own_is_a_file_and_a_new_hyperparameter_two_edits(
    run: Run, failing: Run, tmp_path: Path, tiny_training: Words, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Trained, saved, loaded, changed and evaluated without a package: an argument of a class, and a line of YAML."""
    monkeypatch.setattr("sys.path", [*sys.path])
    monkeypatch.setenv("PYTHONPATH", "")
    own, folder = ("--config-dir", str(tmp_path / "mine")), tmp_path / "run/checkpoints"
    keys = "level: 7\nnum_hypotheses: 32\nfeature_channels: 32\nsquash: 2.5  # how flat\n"
    (tmp_path / "mine/model").mkdir(parents=True)
    (tmp_path / "mine/own_network.py").write_text(OWN_NETWORK)
    (tmp_path / "mine/model/squashed.yaml").write_text(f"_target_: own_network.Squashed\n{keys}")
    help_lines = run("train", *own, "model=squashed", "--help").splitlines()
    assert [line.split() for line in help_lines if "squash=" in line] == [
        ["model.squash=2.5", *["#", "how", "flat"]]
    ]
    words = (*tiny_training, "model=squashed", "model.squash=3.5", "trainer.max_steps=1", "logger=none")
    run("train", *own, *words, "callbacks.panels=null", "output=run")
    for net in (load_weights(folder / "last.safetensors"), read_network(folder / "last.ckpt")):
        assert (net.hyperparameters["squash"], net.hyperparameters["feature_channels"]) == (3.5, 2)
        assert net.with_changes(squash=1.0).hyperparameters == {**net.hyperparameters, "squash": 1.0}
    weights = f"checkpoint={folder / 'last.safetensors'}"
    run("evaluate", *own, *TINY_SCENES, weights, "output=table", "device=cpu")
    assert "last" in (tmp_path / "table/metrics.md").read_text()
    (tmp_path / "mine/model/squashed.yaml").write_text(
        f"_target_: own_network.Squashed\n{keys.replace('squash', 'sqash')}"
    )
    assert "model.sqash: " in failing("train", *own, *tiny_training, "model=squashed", "output=wrong")


def test_faults_in_python_files_of_ones_own_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.path", [*sys.path])
    monkeypatch.setenv("PYTHONPATH", "")
    (tmp_path / "shlex.py").write_text("")
    with pytest.raises(ArgumentError, match="shlex is a module already"):
        import_own_files(tmp_path)
    (tmp_path / "shlex.py").rename(tmp_path / "own_with_fault.py")
    (tmp_path / "own_with_fault.py").write_text("import nothing_of_that_name")
    with pytest.raises(ArgumentError, match=r"own_with_fault\.py: cannot be imported"):
        import_own_files(tmp_path)


@pytest.mark.slow
def test_one_batch_is_learned_by_heart(run: Run, tmp_path: Path, tiny_training: Words) -> None:
    words = ("debug=overfit", "trainer.max_steps=8", "optimizer.lr=1e-2", "logger=csv", "callbacks=none")
    run("train", *(w for w in tiny_training if "val_check" not in w), *words, "output=run")
    (metrics,) = (tmp_path / "run/metrics").glob("*/metrics.csv")
    lines = [line.split(",") for line in metrics.read_text().splitlines()]
    column = lines[0].index("train/loss")
    losses = [float(line[column]) for line in lines[1:] if line[column]]
    assert losses[-1] < losses[0]


EXTRAS = {
    "debug=profiler logger=none trainer.max_steps=2 trainer.val_check_interval=2": (
        (),
        "run/fit-profile.txt",
        "run_training_batch",
    ),
    "logger=wandb logger.wandb.offline=true tags=[mine]": (("wandb",), "run/wandb/offline-run-*/*.wandb", ""),
    "logger=mlflow": (("mlflow", "sqlalchemy"), "run/mlflow.db", "val/MAE"),
    "hparams=optuna hydra.sweeper.n_trials=2 logger=none": (
        ("hydra_plugins.hydra_optuna_sweeper",),
        "run/sweep.json",
        '"run": "1"',
    ),
}
"""Words of a training -> packages that they need, a file that it writes, and a part of that."""


@pytest.mark.slow
@pytest.mark.parametrize("words", EXTRAS)
def test_extras_write_their_files(
    run: Run, tmp_path: Path, tiny_training: Words, monkeypatch: pytest.MonkeyPatch, words: str
) -> None:
    packages, file, content = EXTRAS[words]
    for package in packages:
        pytest.importorskip(package)
    monkeypatch.setenv("WANDB_SILENT", "true")
    run("train", *tiny_training, "trainer.max_steps=1", *words.split(), "callbacks=none", "output=run")
    (path,) = tmp_path.glob(file)
    assert content.encode() in path.read_bytes()


@pytest.mark.slow
def test_progress_is_drawn_wherever_the_output_goes(run: Run, tiny_training: Words) -> None:
    assert "training" in run(
        "train", *tiny_training, "callbacks=rich_progress", "logger=none", "trainer.max_steps=1"
    )


def unavailable() -> None:
    raise ModuleNotFoundError("No module named 'mlflow'", name="mlflow")


def test_packages_that_are_missing_are_named(failing: Run) -> None:
    node = OmegaConf.create({"_target_": f"{__name__}.unavailable"})
    with pytest.raises(ArgumentError, match=r"logger\.mlflow: needs .*'sphericalvision\[mlflow\]'"):
        build(node, "logger.mlflow")
    with pytest.raises(ArgumentError, match=r"pip install mlflow$"):
        build(node, "logger.mine")
    with pytest.raises(FileNotFoundError):  # which says itself what is wrong
        build(OmegaConf.create({"_target_": "os.listdir", "_args_": ["nowhere"]}), "logger.mine")
    assert "pip install 'sphericalvision[launchers]'" in failing("train", "hydra/launcher=moon")
    assert "pip install 'sphericalvision[optuna]'" in failing("train", "hydra/sweeper=moon")


class Locked(CSVLogger):
    """A logger that lacks a key."""

    @property
    def experiment(self) -> Any:
        raise RuntimeError("no key\nwas given")


def test_loggers_that_cannot_begin_are_told_before_anything_is_rendered(
    failing: Run, tmp_path: Path, tiny_training: Words
) -> None:
    words = ("logger=csv", f"logger.csv._target_={__name__}.Locked", "data.cache_dir=scenes", "output=run")
    message = failing("train", *tiny_training, *words).partition("Error: ")[2].strip()
    assert message.startswith("logger.csv: cannot begin (no key was given)")
    assert "\n" not in message
    assert not (tmp_path / "scenes").exists()


@pytest.mark.parametrize("logger", ["csv", "tensorboard", "none"])
def test_loggers_are_made(logger: str, tmp_path: Path) -> None:
    config = composed("train", f"logger={logger}", f"paths.run={tmp_path}")
    for name, node in (config.get("logger") or {}).items():
        assert type(build(node, name)).__name__.lower().startswith(name)


def test_a_table_of_runs_is_in_their_order_and_has_what_differs(tmp_path: Path) -> None:
    """Of twelve, one has failed, one goes on, and one was tested; what is the same in all is no column."""
    for run in range(12):
        words = [f"optimizer.lr={run}", "seed=3", "data.root=a=b", *(["model=other"] if run == 7 else [])]
        write_json(tmp_path / f"{run}/.hydra/overrides.yaml", words)
        if run != 5:
            write_json(tmp_path / f"{run}/validation.json", {"best": {"MAE": run / 2}})
    (tmp_path / "10/failed.txt").write_text("no\nspace")
    write_json(tmp_path / "11/test.json", {"best": {"upright": 0.5}})
    rows = multirun_rows(tmp_path)
    assert [row["run"] for row in rows] == [str(run) for run in range(12) if run != 5]
    assert rows[6] == {"run": "7", "optimizer.lr": "7", "model": "other", "MAE": 3.5}
    assert rows[-2] == {"run": "10", "optimizer.lr": "10", "model": "", "outcome": "failed: no space"}
    assert rows[-1] == {"run": "11", "optimizer.lr": "11", "model": "", "MAE": 5.5, "test upright": 0.5}


def test_a_sweep_goes_on_after_a_run_that_fails(failing: Run, tmp_path: Path, tiny_training: Words) -> None:
    words = (*tiny_training, "trainer.max_steps=1", "logger=none", "output=sweep")
    message = failing("train", "-m", *words, "model.norm=banana,instance")
    assert "norm: expected one of" in message
    assert "1 of the runs failed: 0" in message
    failed, finished = json.loads((tmp_path / "sweep/sweep.json").read_text())
    assert failed["outcome"].startswith("failed: norm: expected one of")
    assert failed["model.norm"] == "banana"
    assert finished["MAE"] > 0
    assert "failed: norm" in (tmp_path / "sweep/sweep.md").read_text()
