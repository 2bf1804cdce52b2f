# SPDX-License-Identifier: Apache-2.0
"""Everything that a file says counts, is told when it is left out, or is refused."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import pytest
import torch

from sphericalvision.cameras import (
    CameraRig,
    KannalaBrandtCamera,
    PinholeCamera,
    read_camera,
    read_cameras,
    read_rig,
    read_trajectory,
    save_rig,
)
from sphericalvision.core import FileFormatError
from tests.cameras.calibration_samples import TEXTS, dump, put, sample
from tests.cameras.test_format_rigs import VINS

LENS = PinholeCamera([300.0, 300.0], [319.5, 239.5], (480, 640))


def moving_rig(folder: Path, suffix: str, start: float = 0.0) -> Path:
    """A model of two cameras 0.2 m apart."""
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[:, 0, 3] = torch.tensor([start, start + 0.2])
    save_rig(CameraRig({"front": LENS, "rear": LENS}, poses), folder / f"cameras{suffix}", "colmap")
    return folder / f"images{suffix}"


@pytest.mark.parametrize("read", [read_rig, read_trajectory])
@pytest.mark.parametrize("suffix", [".txt", ".bin"])
def test_images_of_colmap_agree_with_frames_and_rigs(tmp_path: Path, suffix: str, read: Any) -> None:
    images, later = moving_rig(tmp_path / "old", suffix), moving_rig(tmp_path / "new", suffix, 0.3)
    assert len(read(images)) == 2
    for name in (f"frames{suffix}", f"rigs{suffix}"):
        images.with_name(name).write_bytes(later.with_name(name).read_bytes())
    with pytest.raises(FileFormatError, match=rf"images\{suffix}.*'front\.png'.*0\.3 apart"):
        read(images)


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[:-8],
        lambda text: text.replace("CAMERA 2", "CAMERA x"),
        lambda text: text.replace("CAMERA 2", "CAMERA 1"),  # of another camera than its image
    ],
)
def test_damaged_frames_of_colmap(tmp_path: Path, damage: Any) -> None:
    images = moving_rig(tmp_path, ".txt")
    frames = tmp_path / "frames.txt"
    frames.write_text(damage(frames.read_text()))
    with pytest.raises(FileFormatError, match=r"frames\.txt, line \d"):
        read_rig(images)


def test_a_rig_of_colmap_is_not_one_camera_that_moves(tmp_path: Path) -> None:
    images = moving_rig(tmp_path, ".txt")
    for file in (images, tmp_path / "frames.txt"):
        file.write_text(
            file.read_text().replace("front.png", "front/7.png").replace("rear.png", "rear/7.png")
        )
    with pytest.raises(FileFormatError, match="front and in rear"):
        read_trajectory(images)


ROS: dict[str, Any] = {
    "image_width": 848, "image_height": 800, "distortion_model": "equidistant",
    "camera_matrix": {"rows": 3, "cols": 3, "data": [286.0, 0, 424, 0, 286, 400, 0, 0, 1]},
    "distortion_coefficients": {"rows": 1, "cols": 5, "data": [-0.008, 0.04, -0.038, 0.007, 0.0]},
}  # fmt: skip
KALIBR: dict[str, Any] = {
    "camera_model": "pinhole", "distortion_model": "equidistant", "intrinsics": [286.0, 286, 424, 400],
    "distortion_coeffs": [-0.008, 0.04, -0.038, 0.007, 0.0], "resolution": [848, 800],
}  # fmt: skip


def test_a_fifth_coefficient_of_zero_is_none(tmp_path: Path) -> None:
    cameras = [read_camera(dump(tmp_path / f"{n}.yaml", c)) for n, c in enumerate((ROS, {"cam0": KALIBR}))]
    assert cameras[0].equals(cameras[1])
    assert isinstance(cameras[0], KannalaBrandtCamera)
    assert cameras[0].distortion.tolist() == pytest.approx([-0.008, 0.04, -0.038, 0.007])
    for content in (ROS, {"cam0": KALIBR}):
        five = dump(
            tmp_path / "five.yaml", json.loads(json.dumps(content).replace("0.007, 0.0]", "0.007, 0.1]"))
        )
        with pytest.raises(FileFormatError, match="4 coefficients"):
            read_camera(five)


def test_numbers_of_calibrations_have_bounds(tmp_path: Path) -> None:
    save_rig(CameraRig([LENS, LENS], torch.eye(4).repeat(2, 1, 1)), tmp_path / "rig.json", "basalt")
    text = (tmp_path / "rig.json").read_text()
    far = re.sub(r'"pz": [^,\n]*', '"pz": 1e12', text, count=1)
    (tmp_path / "far.json").write_text(far)
    with pytest.raises(FileFormatError, match="m from the origin"):
        read_rig(tmp_path / "far.json")
    for lens, doubt in (
        ("SIMPLE_PINHOLE 640 480 4.2 320 240", "focal length .*millimetres"),
        ("PINHOLE 640 480 400 4000 320 240", "focal length "),
        ("SIMPLE_RADIAL 640 480 400 320 240 -380", "another unit"),
        ("OPENCV_FISHEYE 640 480 400 400 320 240 50 0 0 0", "another model"),
        ("PINHOLE 640 480 400 320 400 240", "numbers exchanged"),
    ):
        (tmp_path / "cameras.txt").write_text(f"1 {lens}\n2 {lens}\n")
        with pytest.warns(UserWarning, match=f"cam1: .*{doubt}") as told:
            read_camera(tmp_path / "cameras.txt", "cam1")
        assert len(told) == 1  # of the second camera it is probably as true
    stretched = TEXTS["lens.txt"].replace("1.0 0.0 0.0", "1000 0 0")
    short = TEXTS["rig.yaml"].replace("[200.", "[2.")
    for name, text in {"lens.txt": stretched, "rig.yaml": short}.items():
        with pytest.warns(UserWarning, match="focal length "):
            read_cameras(dump(tmp_path / name, text))


@pytest.mark.parametrize(
    ("name", "changes", "said"),
    [
        ("device.json", {"CameraCalibrations/1/Calibrated": False}, "camera-rgb"),
        (
            "device.json",
            {f"CameraCalibrations/{k}/TimeOffsetSec_Device_Camera": 0.05 * k for k in (0, 1)},
            r"CameraCalibrations\[\d\], TimeOffset.* s apart|s apart .*CameraCalibrations",
        ),
        (
            "camchain.yaml",
            {"cam0/timeshift_cam_imu": 0.001, "cam1/timeshift_cam_imu": 0.051},
            r"0\.05 s apart .*cam0, timeshift_cam_imu, and .*cam1",
        ),
        ("rig.yaml", {f"cameras/{k}/time_offset_ns": 30_000_000 * k for k in (0, 1)}, "time_offset_ns"),
    ],
)
def test_what_a_file_says_against_itself_is_told(
    tmp_path: Path, name: str, changes: dict[str, Any], said: str
) -> None:
    content = sample(name)
    for way, value in changes.items():
        put(content, way, value)
    with pytest.warns(UserWarning, match=rf"{name}.*{said}"):
        rig = read_rig(dump(tmp_path / name, content))
    assert rig.names == read_rig(dump(tmp_path / name, sample(name))).names


def test_shots_of_opensfm_are_where_their_rigs_are(tmp_path: Path) -> None:
    content = sample("reconstruction.json")
    content["rig_cameras"] = {"r": {"rotation": [0, 0, 0], "translation": [0.1, 0, 0]}}
    content["rig_instances"] = {
        "0": {"rotation": [0, math.pi / 2, 0], "translation": [0, 0, 2], "rig_camera_ids": {"a.001.jpg": "r"}}
    }
    moved = read_rig(dump(tmp_path / "reconstruction.json", content))
    as_shot = read_rig(dump(tmp_path / "reconstruction.json", sample("reconstruction.json")))
    assert moved.positions[0].tolist() == pytest.approx([2, 0, -0.1], abs=1e-6)
    assert torch.equal(moved.world_from_camera[1:], as_shot.world_from_camera[1:])


def test_poses_of_vins_that_are_a_first_guess_are_told(tmp_path: Path) -> None:
    for name, content in VINS.items():
        dump(tmp_path / name, content | {"estimate_extrinsic": 2} if name == "estimator.yaml" else content)
    with pytest.warns(UserWarning, match="estimate_extrinsic: 2"):
        read_rig(tmp_path / "estimator.yaml")
