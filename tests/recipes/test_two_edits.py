# SPDX-License-Identifier: Apache-2.0
"""A new hyper-parameter is two edits: an argument of the network's class, and its line in the network's YAML file."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from sphericalvision.models import load_weights
from sphericalvision.models.weights.registry import NETWORKS
from sphericalvision.recipes.app.checkpoints import load_network
from tests.recipes.tiny import Run

BEFORE = """
from sphericalvision.models import IcoSweepNet, register_network


class Squashed(IcoSweepNet):
    def __init__(self, level=7, num_hypotheses=32, feature_channels=32):
        super().__init__(level, num_hypotheses, feature_channels=feature_channels, norm="instance")

    def extract_features(self, images):
        return super().extract_features(images)


register_network("squashed", Squashed)
"""
EDIT_OF_THE_CLASS = (
    ("feature_channels=32):", "feature_channels=32, squash=1.0):"),
    ('norm="instance")', 'norm="instance")\n        self.squash = squash'),
    ("(images)\n\n", "((self.squash * images).tanh())\n\n"),
)
YAML = """
_target_: edited_network.Squashed
level: 7
num_hypotheses: 32
feature_channels: 32
"""
EDIT_OF_THE_YAML = "squash: 2.5  # gain before images are limited\n"


@pytest.fixture
def configs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of configurations whose network has got its hyper-parameter in both places, and nowhere else."""
    source = BEFORE
    for old, new in EDIT_OF_THE_CLASS:
        assert source.count(old) == 1
        source = source.replace(old, new)
    (tmp_path / "edited_network.py").write_text(source)
    (tmp_path / "conf/model").mkdir(parents=True)
    (tmp_path / "conf/model/squashed.yaml").write_text(YAML + EDIT_OF_THE_YAML)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path / "conf"
    sys.modules.pop("edited_network", None)
    NETWORKS.things.pop("squashed", None)


def test_a_new_hyperparameter_is_two_edits(
    run: Run, tmp_path: Path, tiny_training: tuple[str, ...], configs: Path
) -> None:
    """It is trained with, saved, loaded, and changed on the command line and afterwards."""
    words = ("trainer.max_steps=1", "logger=none", "callbacks.panels=null", "output=run")
    run("train", "--config-dir", str(configs), *tiny_training, "model=squashed", "model.squash=3.5", *words)
    folder = tmp_path / "run"
    for net in (
        load_weights(folder / "checkpoints/last.safetensors"),
        load_network(folder / "checkpoints/last.ckpt"),
    ):
        assert net.hyperparameters["squash"] == net.squash == 3.5  # type: ignore[comparison-overlap]
        assert net.hyperparameters["feature_channels"] == 2
    stored = torch.load(folder / "checkpoints/last.ckpt", weights_only=True)["hyper_parameters"]
    assert stored["squash"] == 3.5
    assert net.with_changes(squash=1.0).hyperparameters == {**net.hyperparameters, "squash": 1.0}


def test_the_yaml_of_a_network_is_checked_against_its_class(
    run: Run, tiny_training: tuple[str, ...], configs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A line without its argument is told by its key before anything starts."""
    (configs / "model/squashed.yaml").write_text(YAML + EDIT_OF_THE_YAML.replace("squash", "sqash"))
    with pytest.raises(SystemExit):
        run("train", "--config-dir", str(configs), *tiny_training, "model=squashed", "output=run")
    assert "model.sqash: Squashed has no such option" in capsys.readouterr().err
