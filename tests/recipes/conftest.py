# SPDX-License-Identifier: Apache-2.0
"""Run commands in this process, on networks and scenes as small as they get."""

from __future__ import annotations

import contextlib
import importlib
import io
from pathlib import Path
from typing import NamedTuple

import pytest
import torch

from sphericalvision.models import IcoSweepNet, save_weights
from tests.recipes.tiny import TINY_TRAINING, Run, typed


def run_recipe(folder: Path, recipe: str, *arguments: str) -> None:
    """Run a command as its console script would, in ``folder``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("COLUMNS", "1000")  # lines are not wrapped
        patch.setattr("sys.argv", [f"sphericalvision-{recipe}", *arguments])
        importlib.import_module(f"sphericalvision.recipes.{recipe}").main()


@pytest.fixture
def run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command in a folder of its own; gives what it printed."""

    def run_here(recipe: str, *arguments: str) -> str:
        run_recipe(tmp_path, recipe, *arguments)
        return capsys.readouterr().out

    return run_here


@pytest.fixture(scope="session")
def tiny_training(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    """Words of the smallest training; its scenes are rendered once for all tests."""
    return (*TINY_TRAINING, f"data.cache_dir={tmp_path_factory.mktemp('scenes')}")


class Trained(NamedTuple):
    """A finished training: its folder, and what it printed."""

    folder: Path
    printed: str


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory, tiny_training: tuple[str, ...]) -> Trained:
    """Two steps of training."""
    folder = tmp_path_factory.mktemp("trained")
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        run_recipe(
            folder,
            "train",
            *tiny_training,
            *typed("trainer.max_steps=2 output=run callbacks.panels.num_frames=1"),
        )
    return Trained(folder / "run", printed.getvalue())


@pytest.fixture
def failing(run: Run, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command that must fail with status 1 and no traceback; gives what it said on stderr."""

    def run_failing(recipe: str, *arguments: str) -> str:
        with pytest.raises(SystemExit) as stopped:
            run(recipe, *arguments)
        assert stopped.value.code == 1
        message = capsys.readouterr().err
        assert "Traceback" not in message
        assert "Error: " in message
        return message

    return run_failing


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """Weights of an untrained network of level 3, in the form of ``tiny_training``'s."""
    torch.manual_seed(0)
    net = IcoSweepNet(
        level=3,
        num_hypotheses=4,
        feature_channels=2,
        norm="instance",
        aggregation="variance",
        feature_coarsening=1,
        volume_channels=8,
    )
    return save_weights(net, tmp_path / "weights.safetensors")
