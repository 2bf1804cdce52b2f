# SPDX-License-Identifier: Apache-2.0
"""KITTI's raw text, EuRoC's sensor.yaml, and the settings of ORB-SLAM3 and VINS-Fusion."""

from __future__ import annotations

from pathlib import Path

import cv2
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
from tests.cameras.calibration_samples import (
    FISHEYE,
    KITTI,
    RIGHT_OF_FIRST,
    asl,
    assert_projects,
    directions,
    dump,
    flat,
    mei,
    opencv_fisheye,
    opencv_plain,
    orbslam,
)


def test_kitti_cameras_are_opencvs_and_stand_where_it_says(tmp_path: Path) -> None:
    """Coordinates of camera 0 to camera 1: x1 = R x0 + T; what is ahead of the second is to the right of the first."""
    (tmp_path / "calib_cam_to_cam.txt").write_text(KITTI)
    rig = read_rig(tmp_path, dtype=torch.float64)
    rays = directions(25.0)
    matrix = [[989.5, 0, 702.0], [0, 987.8, 245.6], [0, 0, 1]]
    distortion = [-0.36, 0.19, 0.0004, -0.0005, -0.06]
    assert_projects(rig.cameras["cam1"], opencv_plain(rays, matrix, distortion), rays)
    assert rig.cameras["cam0"].image_size == (512, 1392)
    torch.testing.assert_close(rig.positions[1], torch.tensor([0.537, 0.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(rig.axes[1], torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("D_01: -0.36 ", "D_01: ", "line 13, D_01: expected 5 numbers, got 4"),
        ("T_01: 0", "T_01: nan", "line 15, T_01: expected finite numbers"),
        ("S_00: 1392", "S_09: 1392", "the key 'S_00' is missing; found calib_time, corner_dist, S_09"),
        ("R_01: 0 0 -1", "R_01: 0 0 -2", "line 14, R_01: expected a rotation"),
        ("K_01: 989.5 0.0", "K_01: 989.5 0.5", "line 12, K_01: expected fx 0 cx 0 fy cy 0 0 1"),
        ("T_01:", "T_00:", "line 15: expected a key of its own first, got 'T_00:'"),
    ],
)
def test_broken_line_of_kitti_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    (tmp_path / "calib_cam_to_cam.txt").write_text(KITTI.replace(old, new, 1))
    with pytest.raises(ValueError, match=rf"calib_cam_to_cam\.txt[,:] {message}"):
        read_rig(tmp_path)


def test_asl_cameras_of_a_folder_are_a_rig(tmp_path: Path) -> None:
    for name, changes in (("cam0", {"T_BS": flat(np.eye(4))}), ("cam1", {})):
        (tmp_path / "mav0" / name).mkdir(parents=True)
        dump(tmp_path / "mav0" / name / "sensor.yaml", asl(**changes))
    rig = read_rig(tmp_path / "mav0", dtype=torch.float64)
    assert rig.names == ["cam0", "cam1"]
    torch.testing.assert_close(rig.positions[1], torch.tensor([0.1, 0.0, 0.02], dtype=torch.float64))
    torch.testing.assert_close(rig.axes[1], torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    rays = directions(30.0)
    matrix = [[458.6, 0, 367.2], [0, 457.3, 248.4], [0, 0, 1]]
    assert_projects(rig.cameras["cam0"], opencv_plain(rays, matrix, asl()["distortion_coefficients"]), rays)


def test_asl_of_another_sensor_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"sensor\.yaml, sensor_type: expected camera, got 'imu'"):
        read_camera(dump(tmp_path / "sensor.yaml", asl(sensor_type="imu")))


@pytest.mark.parametrize("kind", ["KannalaBrandt8", "PinHole"])
def test_orbslam_cameras_are_opencvs(tmp_path: Path, kind: str) -> None:
    rig = read_rig(dump(tmp_path / "stereo.yaml", orbslam(kind)), dtype=torch.float64)
    rays = directions(30.0)
    numbers = [value for key, value in orbslam(kind).items() if key.startswith("Camera2.")][4:]
    oracle = opencv_fisheye if kind == "KannalaBrandt8" else opencv_plain
    assert_projects(rig.cameras["cam2"], oracle(rays, FISHEYE, numbers), rays)
    torch.testing.assert_close(rig.world_from_camera[1], torch.tensor(RIGHT_OF_FIRST, dtype=torch.float64))


def test_orbslam_body_becomes_the_world(tmp_path: Path) -> None:
    body = np.diag([-1.0, -1.0, 1.0, 1.0])
    body[:3, 3] = 0.0, 0.02, 0.1
    content = orbslam(**{"IMU.T_b_c1": flat(body)})
    rig = read_rig(dump(tmp_path / "stereo.yaml", content), dtype=torch.float64)
    expected = np.stack((body, body @ np.array(RIGHT_OF_FIRST)))
    np.testing.assert_allclose(rig.world_from_camera.numpy(), expected, atol=1e-12)


def test_older_spelling_of_orbslam(tmp_path: Path) -> None:
    content = {key.replace("Camera1.", "Camera."): value for key, value in orbslam().items()}
    content["Tlr"] = flat(RIGHT_OF_FIRST[:3])
    del content["Stereo.T_c1_c2"]
    again = read_rig(dump(tmp_path / "old.yaml", content))
    rig = read_rig(dump(tmp_path / "new.yaml", orbslam()))
    assert all(again.cameras[name].equals(camera) for name, camera in rig.cameras.items())
    assert torch.equal(again.world_from_camera, rig.world_from_camera)
    del content["Tlr"]
    with pytest.raises(ValueError, match="holds 2 cameras without poses"):
        read_rig(dump(tmp_path / "old.yaml", content))


def test_orbslam_reads_what_is_written_for_it(tmp_path: Path) -> None:
    """Its parser is OpenCV's FileStorage, which wants its keys, types and matrices as they are."""
    camera = KannalaBrandtCamera(
        [190.5, 190.25], [254.75, 256.5], [0.5, 0.25, -0.125, 0.0625], (512, 640), 1.5
    )
    pose = torch.tensor(RIGHT_OF_FIRST)
    rig = CameraRig([camera, camera], torch.stack((torch.eye(4), pose)))
    save_rig(rig, tmp_path / "settings.yaml", "orbslam")
    storage = cv2.FileStorage(str(tmp_path / "settings.yaml"), cv2.FILE_STORAGE_READ)
    root = storage.root()
    found = {key: storage.getNode(key) for key in root.keys()}  # noqa: SIM118  # no mapping
    assert found["Camera.type"].string() == "KannalaBrandt8"
    assert [found[f"Camera2.{key}"].real() for key in ("fx", "cy", "k3")] == [190.25 + 0.25, 256.5, -0.125]
    assert (found["Camera.width"].real(), found["Camera.height"].real()) == (640, 512)
    np.testing.assert_array_equal(found["Stereo.T_c1_c2"].mat(), pose.double().numpy())


def test_orbslam_holds_two_of_one_model(tmp_path: Path) -> None:
    fisheye = KannalaBrandtCamera([100.0, 100.0], [49.5, 49.5], [0.0] * 4, (100, 100), 1.5)
    rig = CameraRig(
        [fisheye, PinholeCamera([100.0, 100.0], [49.5, 49.5], (100, 100))], torch.eye(4).repeat(2, 1, 1)
    )
    with pytest.raises(ValueError, match="two of one model"):
        save_rig(rig, tmp_path / "settings.yaml", "orbslam")


def test_vins_takes_cameras_from_files_beside_it(tmp_path: Path) -> None:
    dump(tmp_path / "cam0_mei.yaml", mei())
    dump(tmp_path / "cam1_mei.yaml", mei(camera_name="camera"))
    content = {
        "num_of_cam": 2,
        "cam0_calib": "cam0_mei.yaml",
        "cam1_calib": "cam1_mei.yaml",
        "body_T_cam0": flat(np.eye(4)),
        "body_T_cam1": flat(RIGHT_OF_FIRST),
    }
    rig = read_rig(dump(tmp_path / "estimator.yaml", content), dtype=torch.float64)
    assert rig.names == ["cam0", "cam1"]
    assert rig.cameras["cam1"].equals(read_camera(tmp_path / "cam1_mei.yaml", dtype=torch.float64))
    torch.testing.assert_close(rig.world_from_camera[1], torch.tensor(RIGHT_OF_FIRST, dtype=torch.float64))
    with pytest.raises(FileNotFoundError, match=r"other\.yaml.*the calibration of cam1"):
        read_rig(dump(tmp_path / "estimator.yaml", {**content, "cam1_calib": "other.yaml"}))
    with pytest.raises(ValueError, match=r"estimator\.yaml, cam0_calib: expected the name of a file"):
        read_rig(dump(tmp_path / "estimator.yaml", {**content, "cam0_calib": 3}))
