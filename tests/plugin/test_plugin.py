# SPDX-License-Identifier: Apache-2.0
"""Somebody else's package: installed beside ours, its network and camera work from every command line."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from sphericalvision.io.images import write_image
from tests.processes import python

PLUGIN = Path(__file__).parent

WORDS = (
    "experiment=glass",
    "model.level=3",
    "model.num_hypotheses=4",
    "model.width=3",
    "rig.image_size=[32,32]",
    "data.num_train=3",
    "data.num_val=2",
    "data.samples_per_pixel=1",
    "data.num_workers=0",
    "data.cache_dir=null",
    "trainer.max_steps=2",
    "trainer.val_check_interval=1",
    "trainer.accelerator=cpu",
    "logger=csv",
)

RIG = """
import torch
from glass.camera import EquisolidLens
from sphericalvision.cameras import CameraRig, ring_rig, save_rig
lens = EquisolidLens([9.0], [15.5, 15.5], (32, 32), 1.8)
save_rig(CameraRig([lens] * 4, ring_rig(4, 0.2).world_from_camera), "rig.yaml")
pixels, valid = lens.project(torch.tensor([[0.3, -0.4, 0.1], [0.0, 0.9, -0.1]]))
directions = lens.unproject(pixels).directions
expected = torch.nn.functional.normalize(torch.tensor([[0.3, -0.4, 0.1], [0.0, 0.9, -0.1]]), dim=-1)
torch.testing.assert_close(directions, expected)
assert valid.all()
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the installed package, as pip leaves it."""
    source = tmp_path_factory.mktemp("source") / "glass"
    shutil.copytree(PLUGIN, source, ignore=shutil.ignore_patterns("__pycache__", "test_*", "*.egg-info"))
    target = tmp_path_factory.mktemp("site")
    words = (
        "install",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "--no-index",
        "--target",
        target,
        source,
    )
    pip = [sys.executable, "-m", "pip"]
    if subprocess.run([*pip, "--version"], capture_output=True, check=False).returncode:
        pytest.skip("pip is not in this environment")
    subprocess.run([*pip, *map(str, words)], check=True)
    return target


@pytest.mark.slow
def test_a_network_and_a_camera_of_somebody_elses(installed: Path, tmp_path: Path) -> None:
    """Trained, evaluated, saved, loaded and predicted with; nothing of it stands in this package."""

    def command(name: str, *words: str) -> str:
        return python("-m", f"sphericalvision.recipes.{name}", *words, folder=tmp_path, path=installed)

    printed = command("train", *WORDS, "output=run")
    weights = tmp_path / "run/checkpoints/best.safetensors"
    assert "Evaluate: sphericalvision-evaluate" in printed
    load = f"from sphericalvision.models import load_weights as l; print(repr(l({str(weights)!r}).hyperparameters))"
    assert python("-c", load, folder=tmp_path, path=installed).strip() == (
        "{'level': 3, 'num_hypotheses': 4, 'min_depth': 0.55, 'width': 3}"
    )
    data = [word for word in WORDS if word.startswith(("data.", "rig."))]
    words = (*data, "data.num_test=2", f"checkpoint={weights}", "split=val", "output=table")
    command("evaluate", *words)
    (evaluated,) = json.loads((tmp_path / "table/metrics.json").read_text()).values()
    (validated,) = json.loads((tmp_path / "run/validation.json").read_text()).values()
    assert {name: evaluated[name] for name in validated} == pytest.approx(validated, abs=1e-4)
    python("-c", RIG, folder=tmp_path, path=installed)
    assert "equisolid_lens" in (tmp_path / "rig.yaml").read_text()
    for number in range(1, 5):
        write_image(tmp_path / f"cam{number}.png", torch.rand(3, 32, 32))
    words = (
        "calibration=rig.yaml",
        "images=cam{camera}.png",
        f"checkpoint={weights}",
        "output=out",
        "height=16",
    )
    command("predict", *words)
    assert (tmp_path / "out/depth.npz").is_file()
