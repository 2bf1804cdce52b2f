# SPDX-License-Identifier: Apache-2.0
"""Kalibr's camchain: models, the chain of poses, and writing it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from sphericalvision.cameras import (
    BrownConradyCamera,
    CameraRig,
    DoubleSphereCamera,
    ExtendedUnifiedCamera,
    FisheyeCamera,
    KannalaBrandtCamera,
    PinholeCamera,
    UnifiedCamera,
    read_camera,
    read_rig,
    save_camera,
    save_rig,
)
from sphericalvision.core import FileFormatError
from sphericalvision.geometry import transform_from_axis_angle
from tests.cameras.calibration_samples import (
    KALIBR,
    assert_projects,
    directions,
    double_sphere,
    dump,
    extended_unified,
    kalibr,
    kannala_brandt,
    opencv_fisheye,
    opencv_omnidir,
    opencv_plain,
)

CLASSES = {
    "pinhole none": PinholeCamera,
    "pinhole radtan": BrownConradyCamera,
    "pinhole equidistant": KannalaBrandtCamera,
    "omni none": UnifiedCamera,
    "omni radtan": UnifiedCamera,
    "eucm none": ExtendedUnifiedCamera,
    "ds none": DoubleSphereCamera,
}


def expected_pixels(kind: str, rays: np.ndarray) -> np.ndarray:
    *first, fx, fy, cx, cy = KALIBR[kind]["intrinsics"]
    matrix = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    distortion = KALIBR[kind].get("distortion_coeffs", [0.0] * 4)
    if kind == "pinhole equidistant":
        return opencv_fisheye(rays, matrix, distortion)
    if kind.startswith("pinhole"):
        return opencv_plain(rays, matrix, distortion)
    if kind.startswith("omni"):
        return opencv_omnidir(rays, matrix, first[0], distortion)
    if kind == "ds none":
        return double_sphere(rays, fx, fy, cx, cy, *first)
    return extended_unified(rays, fx, fy, cx, cy, *first)


@pytest.mark.parametrize("kind", KALIBR)
def test_each_model_projects_as_defined(tmp_path: Path, kind: str) -> None:
    rays = directions(25.0 if kind.startswith("pinhole radtan") else 60.0)
    camera = read_camera(dump(tmp_path / "camchain.yaml", kalibr(kind)), dtype=torch.float64)
    assert type(camera) is CLASSES[kind]
    assert_projects(camera, expected_pixels(kind, rays), rays)


def test_equidistant_is_right_past_90_degrees(tmp_path: Path) -> None:
    rays = directions(110.0)
    path = dump(tmp_path / "camchain.yaml", kalibr("pinhole equidistant"))
    camera = read_camera(path, max_angle=math.radians(110), dtype=torch.float64)
    expected = kannala_brandt(
        rays,
        *KALIBR["pinhole equidistant"]["intrinsics"],
        *KALIBR["pinhole equidistant"]["distortion_coeffs"],
    )
    assert_projects(camera, expected, rays)


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


def test_rig_is_read_back_as_written(tmp_path: Path) -> None:
    source = read_rig(dump(tmp_path / "source.yaml", kalibr(*KALIBR)), dtype=torch.float64)
    save_rig(source, tmp_path / "camchain.yaml", format="kalibr")
    again = read_rig(tmp_path / "camchain.yaml", dtype=torch.float64)
    assert again.names == source.names
    assert all(again.cameras[name].equals(camera) for name, camera in source.cameras.items())
    torch.testing.assert_close(again.world_from_camera, source.world_from_camera, rtol=0, atol=1e-14)


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


def test_what_kalibr_cannot_hold_is_refused(tmp_path: Path) -> None:
    fisheye = FisheyeCamera("equisolid", 100.0, [49.5, 49.5], (100, 100), 1.5)
    with pytest.raises(ValueError, match=r"'kalibr' has no fisheye model.*'native'.*convert\(to=\.\.\.\)"):
        save_camera(fisheye, tmp_path / "camchain.yaml", format="kalibr")
    with_k3 = BrownConradyCamera([300.0, 300.0], [49.5, 49.5], [0.0, 0.0, 0.0, 0.0, 0.1], (100, 100), 0.3)
    with pytest.raises(ValueError, match="holds fx fy cx cy k1 k2 p1 p2, and this one has k3="):
        save_camera(with_k3, tmp_path / "camchain.yaml", format="kalibr")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera_model": "fov"}, "cam0, camera_model: expected one of pinhole, omni, eucm, ds, got 'fov'"),
        (
            {"distortion_model": "polynomial"},
            "cam0, distortion_model of a pinhole: expected one of none, radtan, equidistant, fov",
        ),
        ({"intrinsics": [1.0, 2.0, 3.0]}, "cam0, intrinsics (fu fv pu pv): expected 4 numbers, got 3"),
        ({"intrinsics": [0.0, 2.0, 3.0, 4.0]}, "cam0, fu and fv: expected positive focal lengths"),
        ({"distortion_coeffs": [0.1]}, "cam0, distortion_coeffs: expected 4 numbers, got 1"),
        ({"resolution": [752]}, "cam0, resolution: expected 2 numbers"),
        ({"resolution": [752.5, 480]}, "cam0, resolution: expected the width and height"),
    ],
)
def test_broken_camchain_names_file_camera_and_key(tmp_path: Path, changes: dict, message: str) -> None:
    path = dump(tmp_path / "camchain.yaml", kalibr("pinhole radtan", **changes))
    with pytest.raises(ValueError, match=r"camchain\.yaml") as caught:
        read_rig(path)
    assert message in str(caught.value)


def test_missing_or_skewed_pose_is_named(tmp_path: Path) -> None:
    content = kalibr("ds none", "ds none")
    content["cam1"]["T_cn_cnm1"][0][0] = 2.0
    with pytest.raises(ValueError, match=r"cam1, T_cn_cnm1: expected a rotation"):
        read_rig(dump(tmp_path / "chain.yaml", content))
    del content["cam1"]["T_cn_cnm1"]
    with pytest.raises(ValueError, match=r"cam1: the key 'T_cn_cnm1' is missing"):
        read_rig(dump(tmp_path / "chain.yaml", content))


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
