# SPDX-License-Identifier: Apache-2.0
"""360° cameras in every command by one word, and the data that serve networks on spheres and on panoramas."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from sphericalvision.cameras import EquirectangularCamera
from sphericalvision.core import ArgumentError
from sphericalvision.data import OmniStereoDataset, SampleView, collate_samples
from sphericalvision.icosphere import Icosphere
from sphericalvision.io.images import read_image
from sphericalvision.models import (
    DepthNetwork,
    IcoSweepNet,
    OmniMVS,
    WinnerTakesAll,
    load_weights,
    save_weights,
)
from sphericalvision.models.weights.checkpoints import read_network
from sphericalvision.recipes.app.cli import build
from sphericalvision.recipes.datamodules.depth_data_module import DepthDataModule
from sphericalvision.recipes.datamodules.entries import images_of, truth_of
from sphericalvision.recipes.datamodules.scenes import SceneDataModule
from sphericalvision.recipes.training.callbacks import DepthPanels
from sphericalvision.recipes.training.depth_module import DepthModule
from tests.documented import blocks
from tests.recipes.tiny import TINY_SCENES, Run, command_after, composed, typed

TINY_PANORAMAS = ("rig=equirect4", "rig.image_size=[16,32]")


def test_networks_are_trained_and_evaluated_on_panoramas(
    run: Run, tmp_path: Path, tiny_training: tuple[str, ...]
) -> None:
    words = [word for word in tiny_training if "image_size" not in word]
    printed = run(
        "train", *words, *TINY_PANORAMAS, "trainer.max_steps=1", "output=run", "callbacks=none", "logger=none"
    )
    evaluate = command_after(printed, "Evaluate: ")[1:]
    assert "rig=equirect4" in run("evaluate", *evaluate, "output=table", "device=cpu")
    (row,) = json.loads((tmp_path / "table/metrics.json").read_text()).values()
    assert 0 <= row["MAE"] <= row["RMS"] <= 100


def test_panoramas_are_rendered_read_and_predicted(run: Run, tmp_path: Path, weights: Path) -> None:
    root = tmp_path / "set"
    words = ("num_frames=1", "samples_per_pixel=1", "height=16", f"output={root}")
    run("render", *TINY_PANORAMAS, *words)
    sample = OmniStereoDataset(root, split="all")[0]
    assert all(isinstance(camera, EquirectangularCamera) for camera in sample["rig"].cameras.values())
    assert sample["images"]["cam4"].shape == (3, 16, 32)
    images = f"calibration={root}/config.yaml images={root}/cam{{camera}}/{{frame:05d}}.png"
    run(*typed(f"predict {images} checkpoint={weights} output=out device=cpu"))
    assert (tmp_path / "out/00001_depth.npz").is_file()
    run("render", *TINY_PANORAMAS, *words, "num_frames=2")  # the same rig: frames are added
    assert OmniStereoDataset(root, split="all").frames == [1, 2]


def fisheye_scenes(*words: str) -> SceneDataModule:
    tiny = [word for word in TINY_SCENES if "batch_size" not in word]
    config = composed("train", "data=fisheye_scenes", "data.cache_dir=null", *tiny, *words)
    data: SceneDataModule = build(config.data)
    data.bind_network(build(config.model))
    return data


def test_samples_are_those_that_a_network_takes() -> None:
    sphere, panorama = WinnerTakesAll(4, 4, 0.7), OmniMVS(8, 0.5, 2, 3, (8, 32), num_scales=2)
    for net, more, expected in (
        (sphere, (), SampleView(4, 2)),
        (sphere, ("panorama",), SampleView(4, 2, panorama=(80, 160))),
        (panorama, (), SampleView(images=True, panorama=(8, 32))),
        (panorama, ("sphere",), SampleView(5, 3, True, (8, 32))),
    ):
        data = DepthDataModule(batch_size=1)
        data.bind_network(net, *more)
        assert (data.view, data.min_depth) == (expected, net.min_depth)


PAGE = Path(__file__).parents[2] / "docs/tutorials/own-data.md"


def own_batch(*model: str) -> tuple[dict[str, Any], DepthNetwork]:
    """The first batch of the data module that the page shows, for a network, and that network."""
    source = next(block.body for block in blocks(PAGE, "python") if block.title.endswith("my_captures.py"))
    namespace: dict[str, Any] = {"__name__": "my_captures"}
    exec(compile(source, PAGE.name, "exec"), namespace)
    net = build(composed("train", *model).model)
    data = namespace["MyDataModule"](batch_size=1)
    data.bind_network(net)
    return next(iter(data.val_dataloader())), net


@pytest.mark.parametrize(
    "model",
    [
        ("model=icosweepnet_small", "model.level=3"),
        ("model=omnimvs_small", "model.output_size=[32,64]", "model.num_scales=2"),
        ("model=romnistereo_small", "model.output_size=[16,64]"),
    ],
)
def test_the_data_module_of_the_page_serves_any_network(model: tuple[str, ...]) -> None:
    batch, net = own_batch(*model)
    images, seen = images_of(batch, net)
    net.check_images(images, seen)
    inverse_depth, valid = truth_of(batch, net)
    assert inverse_depth.shape == valid.shape == (1, *net.grid.shape)


def test_truth_of_a_finer_icosphere_is_that_of_the_same_vertices() -> None:
    net, fine = WinnerTakesAll(3, 4, 0.5, depth_coarsening=0), Icosphere(5).vertices[None]
    inverse_depth, valid = truth_of({"inverse_depth": fine[..., 1], "valid": fine[..., 1] > 0.3}, net)
    torch.testing.assert_close(inverse_depth[0], net.grid.vertices[:, 1])
    assert torch.equal(valid, inverse_depth > 0.3)


def test_truth_on_a_panorama_of_another_size_names_the_key_of_the_network() -> None:
    batch, net = own_batch("model=omnimvs_small", "model.output_size=[20,40]", "model.num_scales=2")
    words = r"panoramas of 32 x 64 .* OmniMVS estimates it on 20 x 40; set model.output_size=\[32,64\], or \[16,64\]"
    with pytest.raises(ArgumentError, match=words):
        truth_of(batch, net)


def test_both_kinds_of_samples_are_augmented_alike() -> None:
    """The same seed turns the world by the same angle, whatever a sample holds."""
    words = ("model=icosweepnet_small", "model.level=3", "data.panorama_size=[10,20]")
    poses = []
    for entries in ("[sphere]", "[fisheye,panorama]", "[sphere,fisheye,panorama]"):
        data = fisheye_scenes(*words, f"data.entries={entries}").dataset("train")
        torch.manual_seed(3)
        batch = collate_samples([data[0], data[1]])
        poses.append(batch["rig"].world_from_camera)
    assert torch.equal(poses[0], poses[1])
    assert torch.equal(poses[0], poses[2])
    plain = fisheye_scenes(*words).plain_train_dataset()[0]["rig"]
    assert not torch.equal(poses[0], torch.stack([plain.world_from_camera] * 2))


OMNIMVS = (
    *typed("experiment=omnimvs_small model.num_hypotheses=4 model.feature_channels=2 model.num_scales=2"),
    *TINY_SCENES,
    *typed(
        "model.output_size=[20,40] trainer.val_check_interval=1 trainer.accelerator=cpu scheduler=constant"
    ),
)


@pytest.fixture(scope="module")
def cached_scenes(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Where the scenes of these tests are kept."""
    return f"data.cache_dir={tmp_path_factory.mktemp('fisheye')}"


def test_a_training_draws_panels_and_its_best_is_evaluated(
    run: Run, tmp_path: Path, cached_scenes: str
) -> None:
    printed = run(
        "train", *OMNIMVS, cached_scenes, "trainer.max_steps=1", "output=run", "callbacks.panels.num_frames=1"
    )
    assert isinstance(load_weights(tmp_path / "run/checkpoints/last.safetensors"), OmniMVS)
    panel = read_image(tmp_path / "run/panels/000001.png")
    assert panel.shape == (3, 3 * 128, 256)  # estimate, truth and error

    run("evaluate", *command_after(printed, "Evaluate: ")[1:], "output=table", "device=cpu")
    (row,) = json.loads((tmp_path / "table/metrics.json").read_text()).values()
    assert 0 < row["MAE"] < 100


def test_panels_show_no_truth_where_none_is_known() -> None:
    net = IcoSweepNet(3, 4, feature_channels=2)
    module = SimpleNamespace(net=net)
    module.panorama = functools.partial(DepthModule.panorama, module)
    index = 3 * torch.rand(2, net.grid.num_vertices, generator=torch.Generator().manual_seed(0))
    known = torch.tensor([[True], [False]]).expand_as(index)
    panel = DepthPanels("panels", height=8).panel(module, index, index.flip(-1), known)
    assert panel[:, :16].reshape(3, 8, 16, 3).mean((1, 2, 3)).tolist() == pytest.approx(
        [153.7, 152.7, 223.1], abs=0.5
    )
    one, other = panel.reshape(3, 8, 2, 16, 3).transpose(2, 0, 1, 3, 4).reshape(2, 3, 128, 3)
    assert [len(np.unique(rows, axis=0)) > 1 for rows in (*one, *other)] == [True] * 4 + [False] * 2


def test_networks_are_not_mixed_up(
    run: Run, failing: Run, tmp_path: Path, cached_scenes: str, weights: Path
) -> None:
    message = failing("train", *OMNIMVS, cached_scenes, f"init_weights={weights}", "output=other")
    assert "is IcoSweepNet, the network to train OmniMVS" in message
    path = save_weights(
        OmniMVS(4, feature_channels=1, output_size=(32, 64)), tmp_path / "omnimvs.safetensors"
    )
    with pytest.raises(ArgumentError, match="level: OmniMVS has no such hyper-parameter, leave it out"):
        read_network(path).with_changes(level=5)
    assert read_network(path).with_changes(min_depth=1.0).min_depth == 1.0
    sphere_only = [word for word in OMNIMVS if not word.startswith("experiment")]
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
