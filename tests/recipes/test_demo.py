# SPDX-License-Identifier: Apache-2.0
"""The demonstration writes what it promises and prints its folder last."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.recipes.tiny import Run, typed


def test_the_demonstration_writes_everything(
    run: Run, tmp_path: Path, weights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tiny = typed("rig.image_size=[48,48] samples_per_pixel=1 height=32 baseline_scenes=3 device=cpu")
    run("demo", *tiny, f"checkpoint={weights}", "output=demo")
    folder = tmp_path / "demo"
    pictures = typed("depth ground_truth error overview color input_cam1 input_cam2 input_cam3 input_cam4")
    for name in (*(f"{picture}.png" for picture in pictures), "points.ply", "depth.npz", "metrics.md"):
        assert (folder / name).stat().st_size > 0, name
    assert {"index", "depth", "inverse_depth", "directions"} <= set(np.load(folder / "depth.npz"))
    table = json.loads((folder / "metrics.json").read_text())
    assert list(table) == ["IcoSweepNet", "constant depth map", "constant depth", "winner-takes-all"]
    overview = cv2.imread(str(folder / "overview.png")).astype(int)
    height, width = (size // 8 for size in overview.shape[:2])
    blocks = overview[: 8 * height, : 8 * width].reshape(8, height, 8, width, 3)
    assert ((blocks == 255).mean((1, 3, 4)) < 0.8).all()  # no quarter is empty
    assert capsys.readouterr().out.strip().splitlines()[-1] == str(folder)
