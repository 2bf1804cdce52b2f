# SPDX-License-Identifier: Apache-2.0
"""OmniMVS through the same commands as IcoSweepNet: training, resuming, evaluation, prediction."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from sphericalvision.core import ArgumentError
from sphericalvision.io.images import read_image
from sphericalvision.models import OmniMVS, load_weights, save_weights
from sphericalvision.recipes.app.checkpoints import load_network
from sphericalvision.recipes.app.rigs import make_ring
from tests.recipes.tiny import TINY_SCENES, Run, command_after, write_capture

WORDS = (
    "experiment=omnimvs_small",
    "model.num_hypotheses=4",
    "model.feature_channels=2",
    "model.output_size=[20,40]",
    "model.num_scales=2",
    *TINY_SCENES,
    "trainer.val_check_interval=1",
    "trainer.accelerator=cpu",
    "scheduler=constant",
)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Where the scenes of these tests are kept."""
    return f"data.cache_dir={tmp_path_factory.mktemp('fisheye')}"


def state(path: Path) -> dict[str, torch.Tensor]:
    return torch.load(path, weights_only=True)["state_dict"]


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


@pytest.mark.slow  # tests/recipes/test_train.py says so of IcoSweepNet
def test_training_resumes_exactly(run: Run, tmp_path: Path, scenes: str) -> None:
    run("train", *WORDS, scenes, "trainer.max_steps=2", "output=straight")
    run("train", *WORDS, scenes, "trainer.max_steps=1", "output=run")
    last = tmp_path / "run/checkpoints/last.ckpt"
    run("train", *WORDS, scenes, "trainer.max_steps=2", "output=resumed", f"resume={last}")
    straight, resumed = (
        state(tmp_path / f"{name}/checkpoints/last.ckpt") for name in ("straight", "resumed")
    )
    for name, value in straight.items():
        torch.testing.assert_close(resumed[name], value, rtol=0, atol=0, msg=name)


def test_networks_are_not_mixed_up(
    run: Run, failing: Callable[..., str], tmp_path: Path, scenes: str, weights: Path
) -> None:
    message = failing("train", *WORDS, scenes, f"init_weights={weights}", "output=other")
    assert "is IcoSweepNet, the network to train OmniMVS" in message
    path = save_weights(
        OmniMVS(4, feature_channels=1, output_size=(32, 64)), tmp_path / "omnimvs.safetensors"
    )
    with pytest.raises(ArgumentError, match="level: OmniMVS has no such hyper-parameter, leave it out"):
        load_network(path, level=5)
    assert load_network(path, min_depth=1.0).min_depth == 1.0
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


def test_a_capture_becomes_depth_within_the_band(run: Run, tmp_path: Path) -> None:
    net = OmniMVS(4, feature_channels=1, output_size=(16, 64), num_scales=2, aggregation="variance")
    path = save_weights(net, tmp_path / "band.safetensors")
    rig = make_ring(4, radius=0.2, image_size=(40, 48))
    write_capture(tmp_path, rig, {name: torch.rand(3, 40, 48) for name in rig.names}, file="{camera}.png")
    images = f"images={tmp_path}/cam{{camera}}.png"
    run(
        "predict",
        f"calibration={tmp_path / 'rig.yaml'}",
        images,
        f"checkpoint={path}",
        "output=out",
        "height=32",
        "device=cpu",
        "align=false",
    )
    arrays = np.load(tmp_path / "out/depth.npz")
    assert arrays["index"].shape == (16 * 64,)
    assert arrays["directions"].shape == (16 * 64, 3)
    known = np.isfinite(arrays["depth_panorama"])
    assert known[8:24].all()
    assert not known[:8].any()
    assert not known[24:].any()
