# SPDX-License-Identifier: Apache-2.0
"""transforms.json: OpenGL's axes, half a pixel, lenses shared and not, and the older ways to say a focal length."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from sphericalvision.cameras import (
    BrownConradyCamera,
    CameraRig,
    EquirectangularCamera,
    PinholeCamera,
    read_camera,
    read_cameras,
    read_rig,
    save_rig,
)
from tests.cameras.calibration_samples import (
    dump,
    transforms,
)


def test_angle_of_view_stands_for_a_focal_length(tmp_path: Path) -> None:
    """The synthetic NeRF scenes have nothing else, and not even a size."""
    content = {"camera_angle_x": math.pi / 2, "frames": transforms()["frames"]}
    path = dump(tmp_path / "transforms_train.json", content)
    camera = read_camera(path, image_size=(80, 100))
    assert isinstance(camera, PinholeCamera)
    torch.testing.assert_close(camera.focal_length, torch.tensor([50.0, 50.0]))
    assert camera.principal_point.tolist() == [49.5, 39.5]
    with pytest.raises(ValueError, match=r"w and h; pass image_size"):
        read_camera(path)


def test_frames_may_have_lenses_of_their_own(tmp_path: Path) -> None:
    content = transforms(camera_model="OPENCV", k3=0.0, k4=0.0, p1=1e-3, p2=0.0)
    content["frames"][1] |= {"fl_x": 300.0, "w": 640}
    cameras = read_cameras(dump(tmp_path / "transforms.json", content))
    first, second = cameras.values()
    assert isinstance(first, BrownConradyCamera)
    assert isinstance(second, BrownConradyCamera)
    assert (first.focal_length[0].item(), second.focal_length[0].item()) == pytest.approx((190.98, 300.0))
    assert (first.image_size, second.image_size) == ((512, 512), (512, 640))


def test_instant_ngps_flag_makes_a_fisheye(tmp_path: Path) -> None:
    content = transforms(is_fisheye=True)
    del content["camera_model"]
    camera = read_camera(dump(tmp_path / "transforms.json", content))
    assert camera.equals(read_camera(dump(tmp_path / "other.json", transforms())))


def test_panoramas_see_everything(tmp_path: Path) -> None:
    path = dump(tmp_path / "transforms.json", transforms(camera_model="EQUIRECTANGULAR"))
    assert read_camera(path).equals(EquirectangularCamera((512, 512)))
    rig = CameraRig([EquirectangularCamera((64, 128))], torch.eye(4)[None])
    save_rig(rig, path, "nerfstudio")
    assert read_rig(path).cameras["images/cam1"].equals(rig.cameras["cam1"])


def test_poses_come_back_in_opengls_axes(tmp_path: Path) -> None:
    """The writer's matrices are those that nerfstudio expects, not only those that the reader undoes."""
    rig = read_rig(dump(tmp_path / "transforms.json", transforms()), dtype=torch.float64)
    save_rig(rig, tmp_path / "again.json", "nerfstudio")
    frames = json.loads((tmp_path / "again.json").read_text())["frames"]
    for frame, source in zip(frames, transforms()["frames"], strict=True):
        np.testing.assert_allclose(frame["transform_matrix"], source["transform_matrix"], atol=1e-12)
