# SPDX-License-Identifier: Apache-2.0
"""OmniMVS through the same commands as IcoSweepNet: training, resuming, evaluation, prediction."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from sphericalvision.core import ArgumentError
from sphericalvision.io.images import read_image
from sphericalvision.models import OmniMVS, load_weights, save_weights
from sphericalvision.models.weights.checkpoints import read_network
from tests.recipes.tiny import TINY_SCENES, Run, command_after, typed

WORDS = (
    *typed("experiment=omnimvs_small model.num_hypotheses=4 model.feature_channels=2 model.num_scales=2"),
    *TINY_SCENES,
    *typed(
        "model.output_size=[20,40] trainer.val_check_interval=1 trainer.accelerator=cpu scheduler=constant"
    ),
)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Where the scenes of these tests are kept."""
    return f"data.cache_dir={tmp_path_factory.mktemp('fisheye')}"


def test_a_training_draws_panels_and_its_best_is_evaluated(
    run: Run, tmp_path: Path, scenes: str, capsys: pytest.CaptureFixture[str]
) -> None:
    run("train", *WORDS, scenes, "trainer.max_steps=1", "output=run", "callbacks.panels.num_frames=1")
    printed = capsys.readouterr().out
    assert isinstance(load_weights(tmp_path / "run/checkpoints/last.safetensors"), OmniMVS)
    panel = read_image(tmp_path / "run/panels/000001.png")
    assert panel.shape == (3, 3 * 128, 256)  # estimate, truth and error

    run("evaluate", *command_after(printed, "Evaluate: ")[1:], "output=table", "device=cpu")
    (row,) = json.loads((tmp_path / "table/metrics.json").read_text()).values()
    assert 0 < row["MAE"] < 100


def test_networks_are_not_mixed_up(
    run: Run, failing: Callable[..., str], tmp_path: Path, scenes: str, weights: Path
) -> None:
    message = failing("train", *WORDS, scenes, f"init_weights={weights}", "output=other")
    assert "is IcoSweepNet, the network to train OmniMVS" in message
    path = save_weights(
        OmniMVS(4, feature_channels=1, output_size=(32, 64)), tmp_path / "omnimvs.safetensors"
    )
    with pytest.raises(ArgumentError, match="level: OmniMVS has no such hyper-parameter, leave it out"):
        read_network(path).with_changes(level=5)
    assert read_network(path).with_changes(min_depth=1.0).min_depth == 1.0
    sphere_only = [word for word in WORDS if not word.startswith("experiment")]
    message = failing(
        "train",
        "model=omnimvs_small",
        "data=scenes",
        "data.entries=[sphere]",
        *sphere_only,
        "data.cache_dir=null",
        "output=wrong",
    )
    assert "leave out data.entries" in message
