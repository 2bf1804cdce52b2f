# SPDX-License-Identifier: Apache-2.0
"""Configs: every experiment makes its objects, every key is explained, every file is short."""

from __future__ import annotations

import math
import re
from importlib import import_module
from pathlib import Path

import pytest
import torch
from omegaconf import DictConfig, OmegaConf

import sphericalvision.conf
from sphericalvision.data import collate_samples, write_omnistereo
from sphericalvision.recipes.app.checkpoints import initialize
from sphericalvision.recipes.app.checks import check_node, hints_of
from sphericalvision.recipes.app.cli import build
from sphericalvision.recipes.app.rigs import make_ring
from sphericalvision.recipes.datamodules.entries import images_of, truth_of
from tests.recipes.tiny import composed
from tests.worlds import recorded_frames

CONF = Path(sphericalvision.conf.__file__).parent
FOLDER = CONF / "experiment"
EXPERIMENTS = sorted(
    str(path.relative_to(FOLDER).with_suffix("")) for path in FOLDER.rglob("*.yaml") if path.name[0] != "_"
)
OTHERS = ("spherical_digits", "segmentation", "adapt", "refinedsweepnet")
DEPTH_EXPERIMENTS = [name for name in EXPERIMENTS if name not in OTHERS]
FILES = sorted(CONF.rglob("*.yaml"))
DELTAS = ("experiment", "debug", "hparams", "launcher")
"""Groups of changes to keys that are explained elsewhere."""


def train_config(*overrides: str) -> DictConfig:
    return composed("train", *overrides)


@pytest.fixture(scope="module")
def omnistereo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frames in the layout of OmniThings, at the ends of its training and validation splits."""
    root = tmp_path_factory.mktemp("omnithings")
    rig = make_ring(image_size=(32, 32))
    write_omnistereo(root, recorded_frames(rig, [1, 8241], height=32), rig)
    return root


@pytest.mark.parametrize("experiment", DEPTH_EXPERIMENTS)
def test_every_experiment_makes_its_network_and_its_first_sample(experiment: str, omnistereo: Path) -> None:
    data = train_config(f"experiment={experiment}").data
    words: tuple[str, ...] = (f"data.root={omnistereo}", "data.missing=skip")
    if "cache_dir" in data:
        size = "rig.image_size=[32,32]" if "rig" in data else "data.image_size=[32,32]"
        words = ("data.cache_dir=null", "data.samples_per_pixel=1", size)
        words += ("data.levels=null", "data.clues=null") if "clues" in data else ()
    config = train_config(f"experiment={experiment}", *words)
    net, data = build(config.model), build(config.data)
    data.bind_network(net)
    batch = collate_samples([data.dataset("train")[0]])
    images, seen = images_of(batch, net)
    assert seen is not None
    assert images.shape[:3] == (1, len(batch["rig"]), 3)
    assert (seen[:, :, None] | (images == 0)).all()
    inverse_depth, valid = truth_of(batch, net)
    assert inverse_depth.shape == valid.shape == (1, *net.grid.shape)
    assert len(data.dataset("val")) > 0


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_goes_with_the_trainer_of_a_gpu(experiment: str) -> None:
    needed = {"adapt": "capture='c/{camera}/{frame}.png'", "icosweepnet_omnithings": "data.root=omnithings"}
    words = [needed[experiment]] if experiment in needed else []
    config = train_config(f"experiment={experiment}", "trainer=gpu", *words)
    assert config.data.num_workers == 15
    check_node(config.data, "data", ())


def test_adapting_takes_a_capture_and_the_shipped_weights() -> None:
    config = train_config("experiment=adapt", "capture='c/{camera}/{frame}.png'")
    assert (config.data.images, config.init_weights) == ("c/{camera}/{frame}.png", "refinedsweepnet")
    assert config.callbacks.best.monitor == config.task.monitor == "val/photo-consistency"
    assert config.callbacks.best.mode == "max"
    initialize(build(config.model), config.init_weights)
    for group in ("data", "task", "model", "optimizer"):
        check_node(config[group], group, ("net", "loss", "optimizer", "scheduler"))


def test_rooms_to_segment_make_their_network_and_their_first_sample() -> None:
    config = train_config("experiment=segmentation", "data.cache_dir=null", "model.level=3")
    net = build(config.model)
    sample = build(config.data).dataset("train")[0]
    logits = net(sample["values"][None])
    assert logits.shape == (1, 13, *sample["label"].shape)
    assert build(config.loss)(logits, sample["label"][None]).isfinite()


def test_the_papers_training_has_the_papers_numbers() -> None:
    config = train_config("experiment=icosweepnet_omnithings", "data.root=/data/omnithings")
    model, optimizer, data = config.model, config.optimizer, config.data
    assert (model.level, model.num_hypotheses, model.feature_channels, model.min_depth) == (7, 32, 32, 0.55)
    assert (config.trainer.max_steps, data.batch_size) == (54_000, 4)
    assert (optimizer.lr, config.loss.delta) == (1e-3, 1.0)
    assert (data.dataset, data.protocol, data.augment, data.shift) == ("omnithings", "paper", True, 0.5)
    made = build(optimizer)([torch.nn.Parameter(torch.zeros(1))])
    assert isinstance(made, torch.optim.Adam)
    rates = learning_rates(config, 54_000)
    assert [rates[step] for step in (0, 35_999, 36_000, 53_999)] == pytest.approx([1e-3, 1e-3, 1e-4, 1e-4])


def learning_rates(config: DictConfig, steps: int) -> list[float]:
    """The learning rate of each iteration."""
    optimizer = build(config.optimizer)([torch.nn.Parameter(torch.zeros(1))])
    scheduler = build(config.scheduler)(optimizer)
    rates = []
    optimizer.step()  # before the scheduler's first one, as torch wants it; the rates do not depend on the others
    for _ in range(steps):
        rates.append(optimizer.param_groups[0]["lr"])
        scheduler.step()
    return rates


@pytest.mark.parametrize(
    ("experiment", "highest", "last"),
    [
        ("quickstart", 2e-3, 4e-5),
        ("icosweepnet_small", 1.5e-3, 1.5e-5),
        ("spherical_digits", 3e-3, 3e-5),
    ],
)
def test_the_learning_rate_is_a_rise_times_half_a_cosine(
    experiment: str, highest: float, last: float
) -> None:
    """As the weights that ship were trained: (s + 1) / W to 1, times a cosine from 1 to f at the last iteration."""
    config = train_config(f"experiment={experiment}")
    assert (config.optimizer.lr, config.scheduler.cosine.eta_min) == (highest, last)
    steps, warmup, final = config.trainer.max_steps, config.scheduler.warmup.total_iters + 1, last / highest
    assert config.scheduler.warmup.start_factor == 1 / warmup
    expected = [
        highest
        * min(1.0, (s + 1) / warmup)
        * (final + (1 - final) * 0.5 * (1 + math.cos(math.pi * s / steps)))
        for s in range(steps + 1)
    ]
    rates = learning_rates(config, steps + 1)
    assert rates == pytest.approx(expected, rel=2e-3)
    assert rates[-1] == pytest.approx(last, rel=2e-3)
    assert max(rates) < highest


def test_the_plain_cosine_ends_at_nothing() -> None:
    rates = learning_rates(train_config("scheduler=cosine", "trainer.max_steps=40", "optimizer.lr=0.5"), 41)
    assert rates == pytest.approx([0.25 * (1 + math.cos(math.pi * step / 40)) for step in range(41)])


def test_configs_are_short_and_say_what_they_are() -> None:
    for path in FILES:
        lines = path.read_text().splitlines()
        assert len(lines) <= 45, path
        assert lines[0].startswith("#"), path


def test_every_key_is_explained() -> None:
    for path in FILES:
        if path.relative_to(CONF).parts[0] in DELTAS:
            continue
        text = path.read_text().partition("\nhydra:")[0]
        keys = [line for line in text.splitlines() if re.match(r"^( {2})?[a-zA-Z]\w*: *\S", line)]
        assert keys or "defaults" in text or path.stem == "none", path
        for line in keys:
            assert " # " in line, f"{path}: no comment on {line!r}"


COMMANDS = (
    *("train", "evaluate", "predict", "export", "render"),
    *("convert", "calibrate", "align", "inspect", "demo"),
)


@pytest.mark.parametrize("name", [*(path.stem for path in FILES if path.parent == CONF), "study/_study"])
def test_every_key_of_a_command_has_a_type(name: str) -> None:
    keys = {key for key in OmegaConf.load(CONF / f"{name}.yaml") if key not in ("hydra", "defaults")}
    name = name.partition("/")[0]
    hints = hints_of(import_module(f"sphericalvision.recipes.{name}").main.keys)
    assert keys <= {*hints}


@pytest.mark.parametrize("name", COMMANDS)
def test_every_typed_key_of_a_command_is_in_its_file(name: str) -> None:
    hints = hints_of(import_module(f"sphericalvision.recipes.{name}").main.keys)
    assert {*hints} <= {*composed(name).keys()}
