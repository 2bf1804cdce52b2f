# SPDX-License-Identifier: Apache-2.0
"""A rendered rig with a knocked camera is brought back from its own images, from the command line."""

from __future__ import annotations

import re
from pathlib import Path

import torch

from sphericalvision.cameras import CameraRig, read_rig, ring_rig
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.scenes import make_scene, render_rig
from tests.recipes.tiny import Run, write_capture

CAPTURE = ("calibration=c/rig.yaml", "images=c/{camera}/{frame:05d}.png")
WORDS = (*CAPTURE, "num_frames=1")
KNOCKED = ring_rig(3, radius=0.2, image_size=(128, 128))
"""As it is calibrated."""


def true_rig(degrees: float = 1.0) -> CameraRig:
    """As it is: the second camera looks further down."""
    turn = torch.tensor([-torch.pi * degrees / 180, 0.0, 0.0])
    poses = KNOCKED.world_from_camera.clone()
    poses[1] = poses[1] @ transform_from_axis_angle(turn, torch.zeros(3))
    return CameraRig(KNOCKED.cameras, poses)


def write_knocked_capture(folder: Path, degrees: float = 1.0) -> None:
    """``rig.yaml``, as calibrated, and four frames, ``cam1/00000.png`` and so on."""
    rig = true_rig(degrees)
    frames = (render_rig(make_scene("floating", seed=5 + frame), rig, 1) for frame in range(4))
    write_capture(folder, KNOCKED, *frames, file="{camera}/{frame:05d}.png")


def angle_deg(one: torch.Tensor, other: torch.Tensor) -> float:
    """Between two rotations, in degrees."""
    cosine = ((one.mT @ other).diagonal().sum() - 1) / 2
    return float(torch.rad2deg(cosine.double().clamp(max=1).acos()))


def test_a_knocked_camera_is_brought_back(run: Run, failing: Run, tmp_path: Path) -> None:
    write_knocked_capture(tmp_path / "c")
    assert "cameras: expected two or more" in failing("align", *WORDS, "cameras=[cam1]")
    printed = run("align", *WORDS, "output=new/rig.yaml", "check=true")
    turn = re.search(r"turns cam2 by ([\d.]+)° ± ([\d.]+)°", printed)
    assert turn
    assert re.search(rf"cam2\W+{turn[1]}\W+{turn[2]}\W.*turn", printed)  # in the table, too
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
