# SPDX-License-Identifier: Apache-2.0
"""A rendered rig with a knocked camera is brought back from its own images, from the command line."""

from __future__ import annotations

from pathlib import Path

import torch

from sphericalvision.cameras import read_rig
from tests.recipes.knocked_capture import KNOCKED, true_rig, write_knocked_capture
from tests.recipes.tiny import Run

CAPTURE = ("calibration=c/rig.yaml", "images=c/{camera}/{frame:05d}.png")
WORDS = (*CAPTURE, "num_frames=1")


def angle_deg(one: torch.Tensor, other: torch.Tensor) -> float:
    """Between two rotations, in degrees."""
    cosine = ((one.mT @ other).diagonal().sum() - 1) / 2
    return float(torch.rad2deg(cosine.double().clamp(max=1).acos()))


def test_a_knocked_camera_is_brought_back(run: Run, tmp_path: Path) -> None:
    write_knocked_capture(tmp_path / "c")
    printed = run("align", *WORDS, "output=new/rig.yaml", "check=true")
    assert "turns cam2 by" in printed
    for column in ("turned", "shared", "light", "pixels/", "do"):
        assert column in printed
    assert not (tmp_path / "new").exists()
    assert "new/rig.yaml" in run("align", *WORDS, "output=new/rig.yaml")
    found, truth = read_rig(tmp_path / "new" / "rig.yaml"), true_rig()
    poses = [rig.world_from_camera[:, :3, :3] for rig in (found, truth, KNOCKED)]
    between = [angle_deg(pose[0].mT @ pose[1], poses[1][0].mT @ poses[1][1]) for pose in poses]
    assert between[2] > 0.95
    assert between[0] < 0.2
    torch.testing.assert_close(found.positions, truth.positions)


def test_a_rig_that_is_right_is_left_alone(run: Run, tmp_path: Path) -> None:
    write_knocked_capture(tmp_path / "c", degrees=0.0)
    assert "finds the calibration right" in run("align", *WORDS, "output=new.yaml")
    assert not (tmp_path / "new.yaml").exists()


def test_one_camera_is_compared_with_nothing(failing: Run, tmp_path: Path) -> None:
    write_knocked_capture(tmp_path / "c")
    assert "cameras: expected two or more" in failing("align", *WORDS, "cameras=[cam1]")
