# SPDX-License-Identifier: Apache-2.0
"""The demonstration writes what it promises and prints its folder last."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.recipes.tiny import Run


def test_the_demonstration_writes_everything(
    run: Run, tmp_path: Path, weights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tiny = (
        "rig.image_size=[48,48]",
        "samples_per_pixel=1",
        "height=32",
        "baseline_scenes=3",
        "device=cpu",
    )
    run("demo", *tiny, f"checkpoint={weights}", "output=demo")
    folder = tmp_path / "demo"
    pictures = (
        "depth",
        "ground_truth",
        "error",
        "overview",
        "color",
        *(f"input_cam{n}" for n in range(1, 5)),
    )
    for name in (*(f"{picture}.png" for picture in pictures), "points.ply", "depth.npz", "metrics.md"):
        assert (folder / name).stat().st_size > 0, name
    assert {"index", "depth", "inverse_depth", "directions"} <= set(np.load(folder / "depth.npz"))
    table = json.loads((folder / "metrics.json").read_text())
    assert list(table) == ["IcoSweepNet", "photo-consistency sweep", "constant depth map", "constant depth"]
    assert capsys.readouterr().out.strip().splitlines()[-1] == str(folder)
