# SPDX-License-Identifier: Apache-2.0
"""Configs: every experiment makes its objects, every key is explained, every file is short."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_module
from omegaconf import DictConfig, OmegaConf

import sphericalvision.conf
from sphericalvision.data import write_omnistereo
from sphericalvision.models import OmniMVS
from sphericalvision.recipes.app.cli import build
from sphericalvision.recipes.app.frames import RenderedFrames
from sphericalvision.recipes.app.rigs import make_ring

CONF = Path(sphericalvision.conf.__file__).parent
EXPERIMENTS = sorted(path.stem for path in (CONF / "experiment").glob("*.yaml"))
DEPTH_EXPERIMENTS = [name for name in EXPERIMENTS if name != "spherical_digits"]
FILES = sorted(CONF.rglob("*.yaml"))


def train_config(*overrides: str) -> DictConfig:
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        return compose("train", list(overrides))


@pytest.fixture(scope="module")
def omnistereo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frames in the layout of OmniThings, at the ends of its training and validation splits."""
    root = tmp_path_factory.mktemp("omnithings")
    rig = make_ring(image_size=(32, 32))
    write_omnistereo(root, RenderedFrames(rig, [1, 8241], samples_per_pixel=1, height=32), rig)
    return root


@pytest.mark.parametrize("experiment", DEPTH_EXPERIMENTS)
def test_every_experiment_makes_its_network_and_its_first_sample(experiment: str, omnistereo: Path) -> None:
    rendered = "rig" in train_config(f"experiment={experiment}").data
    scenes = ("data.cache_dir=null", "data.samples_per_pixel=1", "rig.image_size=[32,32]")
    words = scenes if rendered else (f"data.root={omnistereo}", "data.missing=skip")
    config = train_config(f"experiment={experiment}", *words)
    module = build(config.model, **config.optimizer, seed=config.seed)
    data = build(config.data)
    sample = data.dataset("train")[0]
    if isinstance(module.net, OmniMVS):
        assert sample["fisheye"].shape == (4, 3, 32, 32)
        assert sample["panorama_inverse_depth"].shape == module.net.grid.shape
    else:
        level = module.net.hyperparameters["level"]
        assert sample["images"].shape == (4, 3, 2 + 10 * 4**level)
        assert sample["inverse_depth"].shape == (2 + 10 * 4 ** (level - 2),)
    assert len(data.dataset("val")) > 0


def test_the_digits_make_their_network_and_their_first_sample() -> None:
    config = train_config("experiment=spherical_digits")
    module = build(config.model, **config.optimizer, seed=config.seed)
    sample = build(config.data).dataset("train")[0]
    assert module(sample["values"][None]).shape == (1, 10)


def test_the_papers_training_has_the_papers_numbers() -> None:
    config = train_config("experiment=icosweepnet_omnithings", "data.root=/data/omnithings")
    model, optimizer, data = config.model, config.optimizer, config.data
    assert (model.level, model.num_hypotheses, model.feature_channels, model.min_depth) == (7, 32, 32, 0.55)
    assert (config.trainer.max_steps, data.batch_size) == (54_000, 4)
    assert (optimizer.learning_rate, optimizer.schedule, optimizer.huber_delta) == (1e-3, "step", 1.0)
    assert (optimizer.decay_after, optimizer.decay_factor) == (36_000, 0.1)
    assert (data.dataset, data.protocol, data.photometric, data.shift) == ("omnithings", "paper", True, 0.5)
    module = build(model, **optimizer, seed=0)
    configured = module.configure_optimizers()
    assert isinstance(configured["optimizer"], torch.optim.Adam)
    factor = configured["lr_scheduler"]["scheduler"].lr_lambdas[0]
    assert [factor(step) for step in (0, 35_999, 36_000, 53_999)] == [1.0, 1.0, 0.1, 0.1]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(CONF)))
def test_configs_are_short_and_say_what_they_are(path: Path) -> None:
    lines = path.read_text().splitlines()
    assert len(lines) <= 40
    assert lines[0].startswith("#")


@pytest.mark.parametrize(
    "path", [p for p in FILES if p.parent.name != "experiment"], ids=lambda path: path.stem
)
def test_every_key_is_explained(path: Path) -> None:
    text = path.read_text().partition("\nhydra:")[0]
    keys = [
        line for line in text.splitlines() if re.match(r"^( {2})?\w+: *\S", line) and "_target_" not in line
    ]
    assert keys or "defaults" in text
    for line in keys:
        assert " # " in line, f"{path.name}: no comment on {line!r}"


@pytest.mark.parametrize(
    "name", ["train", "evaluate", "predict", "render", "convert", "inspect", "demo", "digits_table"]
)
def test_every_command_composes(name: str) -> None:
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        config = compose(name)
    assert "output" in config
    assert OmegaConf.is_config(config)
