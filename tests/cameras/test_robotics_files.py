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
    read_camera,
    read_rig,
    save_rig,
)
from tests.cameras.calibration_samples import (
    RIGHT_OF_FIRST,
    asl,
    dump,
    flat,
    mei,
    orbslam,
)


def test_asl_cameras_of_a_folder_are_a_rig(tmp_path: Path) -> None:
    for name, changes in (("cam2", {"T_BS": flat(np.eye(4))}), ("cam10", {})):
        (tmp_path / "mav0" / name).mkdir(parents=True)
        dump(tmp_path / "mav0" / name / "sensor.yaml", asl(**changes))
    rig = read_rig(tmp_path / "mav0", dtype=torch.float64)
    assert rig.names == ["cam2", "cam10"]
    torch.testing.assert_close(rig.positions[1], torch.tensor([0.1, 0.0, 0.02], dtype=torch.float64))
    torch.testing.assert_close(rig.axes[1], torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))


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
    (tmp_path / "note.yaml").write_text("nothing: 1")
    with pytest.raises(ValueError, match=r"note\.yaml: expected .*estimator\.yaml names it for cam1"):
        read_rig(dump(tmp_path / "estimator.yaml", {**content, "cam1_calib": "note.yaml"}))
    with pytest.raises(ValueError, match=r"estimator\.yaml, cam0_calib: expected the name of a file"):
        read_rig(dump(tmp_path / "estimator.yaml", {**content, "cam0_calib": 3}))
