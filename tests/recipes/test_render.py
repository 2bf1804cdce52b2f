# SPDX-License-Identifier: Apache-2.0
"""Rendering: what is written is read back and evaluated, an interrupted set is completed; and the demonstration."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sphericalvision.cameras.fingerprint import rig_fingerprint
from sphericalvision.data import OmniStereoDataset
from sphericalvision.io.images import read_image
from sphericalvision.io.yaml_files import write_yaml
from sphericalvision.recipes.app.rigs import make_ring
from sphericalvision.recipes.commands.render import numbered_frame
from sphericalvision.scenes import World
from tests.recipes.tiny import Run, typed
from tests.worlds import recorded_frames

TINY = ("rig.image_size=[32,32]", "samples_per_pixel=1", "height=32")


@pytest.mark.parametrize("release", ["png", "tiff"])
def test_a_rendered_set_is_read_back_and_evaluated(
    run: Run, tmp_path: Path, weights: Path, release: str
) -> None:
    root = tmp_path / "set"
    run("render", f"output={root}", "num_frames=2", f"release={release}", *TINY)
    read = OmniStereoDataset(root, split="all")
    assert read.frames == [1, 2]
    rendered = recorded_frames(make_ring(image_size=(32, 32)), [1, 2])
    for got, made in zip((read[0], read[1]), (rendered[0], rendered[1]), strict=True):
        tolerance = 1e-6 if release == "tiff" else 0.51 / (65500 * 0.55)
        torch.testing.assert_close(got["inverse_depth"], made["inverse_depth"], rtol=0, atol=tolerance)
        for name, image in made["images"].items():
            torch.testing.assert_close(got["images"][name], image, rtol=0, atol=0.51 / 255)
        torch.testing.assert_close(
            got["rig"].world_from_camera, made["rig"].world_from_camera, rtol=0, atol=1e-5
        )

    splits = "data.test_split=all data.train_split=all data.num_workers=0"
    data = typed(f"data=omnistereo data.root={root} {splits}")
    run("evaluate", *data, f"checkpoint={weights}", "baselines=true", "output=table", "device=cpu")
    table = json.loads((tmp_path / "table/metrics.json").read_text())
    assert list(table) == [
        "weights",
        "constant depth map",
        "constant depth",
        "winner-takes-all",
        "semi-global-sweep",
    ]
    assert all(0 <= row["MAE"] <= row["RMS"] <= 100 for row in table.values())
    assert table["constant depth map"]["MAE"] < table["weights"]["MAE"]


def test_rendering_goes_on_with_what_is_missing(run: Run, tmp_path: Path) -> None:
    """What is there is not rendered again."""
    root = tmp_path / "set"
    run("render", f"output={root}", "num_frames=3", *TINY)
    (root / "cam1/00003.png").write_bytes(b"kept")
    before = contents(root)
    for name in ("cam4/00001.png", "depth_train_640/00002.png"):
        (root / name).unlink()
    run("render", f"output={root}", "num_frames=3", *TINY)
    assert contents(root) == before
    run("render", f"output={root}", "num_frames=4", *TINY)
    assert OmniStereoDataset(root, split="all").frames == [1, 2, 3, 4]


@pytest.mark.parametrize(
    "word",
    ["kind=room", "first_seed=7", "height=20", "samples_per_pixel=2", "scale=1.5", "carrier=pole"],
)
def test_frames_of_other_settings_are_not_mixed_in(run: Run, failing: Run, tmp_path: Path, word: str) -> None:
    root = tmp_path / "set"
    root.mkdir()
    settings = {
        "kind": ["room", "floating"],
        "first_seed": 0,
        "scale": 1.0,
        "samples_per_pixel": 1,
        "height": 32,
        "min_depth": 0.55,
    }
    rig = rig_fingerprint(make_ring(image_size=(32, 32)), digits=6)
    write_yaml(root / "rendered.yaml", {**settings, "release": "png", "rig": rig})
    message = failing("render", f"output={root}", "num_frames=1", *TINY, word)
    key, _, value = word.partition("=")
    assert f"({key} was {settings.get(key)}, is {value})" in message
    assert [path.name for path in root.iterdir()] == ["rendered.yaml"]


def test_frames_from_elsewhere_are_not_mixed_with(failing: Run, tmp_path: Path) -> None:
    (tmp_path / "set/depth_train_640").mkdir(parents=True)
    (tmp_path / "set/depth_train_640/00001.png").touch()
    assert "no rendered.yaml" in failing("render", "output=set", "num_frames=2", *TINY)


def test_a_frame_depends_on_its_seed_alone() -> None:
    rig = make_ring(image_size=(16, 16))
    world = World(rig, ["room", "floating"])
    first, other = numbered_frame(world, 0, 16, 5), numbered_frame(world, 4, 16, 1)
    assert (first["frame"], other["frame"]) == ("00005", "00001")
    assert torch.equal(first["inverse_depth"], other["inverse_depth"])
    assert torch.equal(first["images"]["cam1"], other["images"]["cam1"])
    assert [world.frame(seed).kind for seed in range(3)] == ["room", "floating", "room"]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
@pytest.mark.parametrize("release", ["png", "tiff"])
def test_four_shards_are_one_set(run: Run, tmp_path: Path, release: str) -> None:
    """Byte for byte the set of one run; shards that were stopped, with files missing, go on."""
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    words = ("rig=ring", *TINY, f"release={release}")
    joblib = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "hydra.sweep.dir=jobs", "num_frames=2")
    shards = (*words, "-m", *joblib, "first_frame=1,3,5,7", f"output={tmp_path}/shards")
    run("render", *words, "num_frames=8", "output=whole")
    run("render", *shards)
    whole = contents(tmp_path / "whole")
    assert sum(name.startswith("ocam") for name in whole) == (4 if release == "png" else 0)
    assert contents(tmp_path / "shards") == whole
    for name in ("cam1/00004.png", "cam3/00008.png"):
        (tmp_path / "shards" / name).unlink()
    run("render", *shards)
    assert contents(tmp_path / "shards") == whole


def test_the_demonstration_writes_everything(run: Run, tmp_path: Path, weights: Path) -> None:
    tiny = typed("rig.image_size=[48,48] samples_per_pixel=1 height=32 baseline_scenes=3 device=cpu")
    printed = run("demo", *tiny, f"checkpoint={weights}", "output=demo")
    folder = tmp_path / "demo"
    pictures = typed("depth ground_truth error overview color input_cam1 input_cam2 input_cam3 input_cam4")
    for name in (*(f"{picture}.png" for picture in pictures), "points.ply", "depth.npz", "metrics.md"):
        assert (folder / name).stat().st_size > 0, name
    assert {"index", "depth", "inverse_depth", "directions"} <= set(np.load(folder / "depth.npz"))
    world = World(make_ring(image_size=(48, 48)), "room", samples_per_pixel=1)  # of a seed that is held out
    image = numbered_frame(world, 3_000_000, 32, 1)["images"]["cam1"]
    torch.testing.assert_close(read_image(folder / "input_cam1.png"), image, atol=1 / 255, rtol=0)
    table = json.loads((folder / "metrics.json").read_text())
    assert list(table) == ["IcoSweepNet", "constant depth map", "constant depth", "winner-takes-all"]
    overview = cv2.imread(str(folder / "overview.png")).astype(int)
    height, width = (size // 8 for size in overview.shape[:2])
    blocks = overview[: 8 * height, : 8 * width].reshape(8, height, 8, width, 3)
    assert ((blocks == 255).mean((1, 3, 4)) < 0.8).all()  # no quarter is empty
    assert printed.strip().splitlines()[-1] == str(folder)
