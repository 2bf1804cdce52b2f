# SPDX-License-Identifier: Apache-2.0
"""A set rendered in four shards by Hydra's launcher is, byte for byte, the set of one run; a shard goes on."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.recipes.tiny import Run

pytestmark = pytest.mark.slow

WORDS = ["rig=ring", "rig.image_size=[48,48]", "samples_per_pixel=1", "height=48"]
SHARDS = ["-m", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "hydra.sweep.dir=jobs", "num_frames=2"]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("release", ["png", "tiff"])
def test_four_shards_are_one_set(run: Run, tmp_path: Path, release: str) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    run("render", *WORDS, f"release={release}", "num_frames=8", "output=whole")
    run("render", *WORDS, f"release={release}", *SHARDS, "first_frame=1,3,5,7", f"output={tmp_path}/shards")
    whole, shards = contents(tmp_path / "whole"), contents(tmp_path / "shards")
    assert sum(name.startswith("ocam") for name in whole) == (4 if release == "png" else 0)
    assert whole == shards
    # Shards that were stopped: files missing, empty, cut off.
    (tmp_path / "shards/cam1/00004.png").unlink()
    (tmp_path / "shards/cam2/00005.png").write_bytes(b"")
    shutil.copy(tmp_path / "whole/cam3/00008.png", tmp_path / "shards/cam3/00008.png.part")
    (tmp_path / "shards/cam3/00008.png").write_bytes(whole["cam3/00008.png"][:100])
    (tmp_path / "shards/cam3/00008.png.part").unlink()
    run("render", *WORDS, f"release={release}", *SHARDS, "first_frame=1,3,5,7", f"output={tmp_path}/shards")
    assert contents(tmp_path / "shards") == whole
