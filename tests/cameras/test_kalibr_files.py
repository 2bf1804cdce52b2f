# SPDX-License-Identifier: Apache-2.0
"""Kalibr's camchain: models, the chain of poses, and writing it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from sphericalvision.cameras import (
    CameraRig,
    KannalaBrandtCamera,
    PinholeCamera,
    read_camera,
    read_rig,
    save_rig,
)
from sphericalvision.core import FileFormatError
from sphericalvision.geometry import transform_from_axis_angle
from tests.cameras.calibration_samples import (
    KALIBR,
    dump,
    kalibr,
)


def test_chain_leads_from_each_camera_to_the_next(tmp_path: Path) -> None:
    """Three cameras, each 10 cm to the right of the one before as that one sees it, looking 90° further right."""
    rig = read_rig(dump(tmp_path / "camchain.yaml", kalibr("ds none", "eucm none", "omni none")))
    assert rig.names == ["cam0", "cam1", "cam2"]
    axes = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 0, -1]])
    positions = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0.1, 0, -0.1]])
    torch.testing.assert_close(rig.axes, axes, rtol=0, atol=1e-6)
    torch.testing.assert_close(rig.positions, positions, rtol=0, atol=1e-6)


def test_imu_transforms_place_cameras_in_the_imu_frame(tmp_path: Path) -> None:
    content = kalibr("ds none", "ds none")
    del content["cam1"]["T_cn_cnm1"]  # as in files that only have the IMU's
    for index, shift in enumerate((0.05, -0.05)):
        pose = np.eye(4)
        pose[0, 3] = shift  # the IMU's origin is to the right of cam0, to the left of cam1
        content[f"cam{index}"]["T_cam_imu"] = pose.tolist()
    rig = read_rig(dump(tmp_path / "chain.yaml", content))
    torch.testing.assert_close(rig.positions, torch.tensor([[-0.05, 0, 0], [0.05, 0, 0]]))


def test_cameras_are_ordered_by_number(tmp_path: Path) -> None:
    content = kalibr(*["ds none"] * 11)
    shuffled = {name: content[name] for name in sorted(content)}  # cam0, cam1, cam10, cam2, ...
    assert read_rig(dump(tmp_path / "chain.yaml", shuffled)).names == [f"cam{index}" for index in range(11)]


def test_written_chain_and_imu_transforms_say_the_same(tmp_path: Path) -> None:
    turns = torch.tensor([[0.1, 0.2, -0.3], [0.0, 2.0, 0.5], [-3.0, 0.4, 0.1]], dtype=torch.float64)
    poses = transform_from_axis_angle(turns, 0.1 * turns.flip(0))
    rig = CameraRig([PinholeCamera([100.0, 100.0], [49.5, 49.5], (100, 100))] * 3, poses)
    save_rig(rig, tmp_path / "camchain.yaml", format="kalibr")
    text = (tmp_path / "camchain.yaml").read_text().replace("T_cam_imu", "comment")
    (tmp_path / "chain.yaml").write_text(text)
    chained = read_rig(tmp_path / "chain.yaml", dtype=torch.float64)
    moved = rig.world_from_camera[0] @ chained.world_from_camera  # from the frame of cam0
    torch.testing.assert_close(moved, rig.world_from_camera, rtol=0, atol=1e-14)


def test_openvins_gives_the_inverse_transform(tmp_path: Path) -> None:
    """Its ``T_imu_cam`` takes camera coordinates to the IMU's: the same rig as of ``T_cam_imu`` the other way round."""
    angles = torch.tensor([[0.1, -0.2, 0.3], [0.0, 0.4, 0.1]], dtype=torch.float64)
    places = torch.tensor([[0.1, 0.0, 0.05], [-0.1, 0.02, 0.0]], dtype=torch.float64)
    to_imu = transform_from_axis_angle(angles, places)
    content = {
        f"cam{index}": {**KALIBR["pinhole equidistant"], "T_imu_cam": pose.tolist()}
        for index, pose in enumerate(to_imu)
    }
    rig = read_rig(dump(tmp_path / "camchain.yaml", content), dtype=torch.float64)
    torch.testing.assert_close(rig.world_from_camera, to_imu)
    for index, pose in enumerate(to_imu):
        content[f"cam{index}"] = {
            **KALIBR["pinhole equidistant"],
            "T_cam_imu": torch.linalg.inv(pose).tolist(),
        }
    again = read_rig(dump(tmp_path / "camchain.yaml", content), dtype=torch.float64)
    torch.testing.assert_close(again.world_from_camera, to_imu)
    alone = {"cam0": {**KALIBR["pinhole equidistant"], "T_imu_cam": to_imu[0].tolist()}}
    single = read_rig(dump(tmp_path / "camchain.yaml", alone), dtype=torch.float64)
    torch.testing.assert_close(single.world_from_camera[0], to_imu[0])


def test_one_camera_without_a_transform_has_no_pose(tmp_path: Path) -> None:
    path = dump(tmp_path / "camchain.yaml", {"cam0": KALIBR["pinhole equidistant"]})
    assert type(read_camera(path)) is KannalaBrandtCamera
    with pytest.raises(FileFormatError, match="one camera without poses"):
        read_rig(path)
