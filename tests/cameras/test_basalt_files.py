# SPDX-License-Identifier: Apache-2.0
"""Basalt's json: its camera types, and writing them with poses and masks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from sphericalvision.cameras import (
    BrownConradyCamera,
    CameraRig,
    DoubleSphereCamera,
    ExtendedUnifiedCamera,
    KannalaBrandtCamera,
    OCamCamera,
    PinholeCamera,
    UnifiedCamera,
    read_camera,
    read_rig,
    save_camera,
    save_rig,
)
from sphericalvision.geometry import transform_from_axis_angle
from tests.cameras.calibration_samples import (
    assert_projects,
    basalt,
    directions,
    double_sphere,
    dump,
    extended_unified,
    kannala_brandt,
    opencv_plain,
)

CENTER = (254.96, 256.89)
CLASSES = {
    "ds": DoubleSphereCamera,
    "eucm": ExtendedUnifiedCamera,
    "ucm": UnifiedCamera,
    "kb4": KannalaBrandtCamera,
    "pinhole": PinholeCamera,
}


def expected_pixels(kind: str, rays: np.ndarray) -> np.ndarray:
    if kind == "ds":
        return np.asarray(double_sphere(rays, 158.3, 158.2, *CENTER, -0.17, 0.593))
    if kind == "eucm":
        return np.asarray(extended_unified(rays, 191.1, 191.2, *CENTER, 0.63, 1.04))
    if kind == "ucm":  # the extended model with beta 1
        return np.asarray(extended_unified(rays, 191.1, 191.2, *CENTER, 0.63, 1.0))
    if kind == "kb4":
        return np.asarray(kannala_brandt(rays, 190.98, 190.97, *CENTER, 0.0035, 0.0007, -0.002, 2e-4))
    return opencv_plain(rays, [[300.5, 0, CENTER[0]], [0, 301.0, CENTER[1]], [0, 0, 1]], [0.0] * 4)


@pytest.mark.parametrize("kind", CLASSES)
def test_each_type_projects_as_defined(tmp_path: Path, kind: str) -> None:
    rays = directions(60.0 if kind == "pinhole" else 97.0)
    camera = read_camera(dump(tmp_path / "calibration.json", basalt(kind)), dtype=torch.float64)
    assert type(camera) is CLASSES[kind]
    assert_projects(camera, expected_pixels(kind, rays), rays)


def test_rig_is_read_back_as_written(tmp_path: Path) -> None:
    source = read_rig(dump(tmp_path / "source.json", basalt(*CLASSES)), dtype=torch.float64)
    turns = torch.tensor(
        [[0.1, 0.2, 0.3], [np.pi, 0, 0], [0, 3.14, 1e-3], [1e-9, 0, 0], [-2.0, 0.5, 1.0]], dtype=torch.float64
    )
    poses = transform_from_axis_angle(turns, 0.1 * turns)
    mask = torch.zeros(512, 512, dtype=torch.bool)
    mask[100:400, 100:400] = True
    rig = CameraRig(source.cameras, poses, {"cam1": mask})
    save_rig(rig, tmp_path / "calibration.json", format="basalt")
    again = read_rig(tmp_path / "calibration.json", dtype=torch.float64)
    torch.testing.assert_close(again.world_from_camera, poses, rtol=0, atol=1e-12)
    assert torch.equal(again.masks["cam1"], mask)
    for name, camera in source.cameras.items():
        restored = again.cameras[name].with_max_angle(camera.max_angle)
        if name == "cam2":  # ucm has other parameters, equal up to the last digit
            rays = torch.from_numpy(directions(90.0))
            torch.testing.assert_close(
                restored.project(rays).pixels, camera.project(rays).pixels, rtol=0, atol=1e-10
            )
        else:
            assert restored.equals(camera)


def test_what_basalt_cannot_hold_is_refused(tmp_path: Path) -> None:
    lens = OCamCamera([-100.0, 0.0, 0.0025], None, [49.5, 49.5], [1.0, 0.0, 0.0], (100, 100), 1.0)
    with pytest.raises(ValueError, match=r"'basalt' has no ocam model.*'native' or 'ocamcalib' or 'omnimvs'"):
        save_camera(lens, tmp_path / "calibration.json", format="basalt")
    mei = UnifiedCamera([100.0, 100.0], [49.5, 49.5], 1.0, [0.1, 0.0, 0.0, 0.0, 0.0], (100, 100))
    with pytest.raises(ValueError, match=r"holds fx fy cx cy xi, and this one has k1="):
        save_camera(mei, tmp_path / "calibration.json", format="basalt")


RADTAN8 = {"k1": 0.4, "k2": -2.5, "p1": 6e-4, "p2": -3e-4, "k3": 1.6, "k4": 0.28, "k5": -2.3, "k6": 1.5}


@pytest.mark.parametrize("radius", [0.0, 0.8])
def test_rational_distortion_is_read_and_written(tmp_path: Path, radius: float) -> None:
    content = basalt("pinhole")
    intrinsics = content["value0"]["intrinsics"][0]
    intrinsics["camera_type"] = "pinhole-radtan8"
    intrinsics["intrinsics"] |= {**RADTAN8, "rpmax": radius}
    camera = read_camera(dump(tmp_path / "calibration.json", content), dtype=torch.float64)
    assert isinstance(camera, BrownConradyCamera)
    matrix = [[300.5, 0, CENTER[0]], [0, 301.0, CENTER[1]], [0, 0, 1]]
    rays = directions(30.0)
    assert_projects(camera, opencv_plain(rays, matrix, list(RADTAN8.values())), rays)
    if radius:
        assert camera.max_angle <= np.arctan(radius)
    save_camera(camera, tmp_path / "again.json", format="basalt")
    again = read_camera(tmp_path / "again.json", dtype=torch.float64)
    assert again.with_max_angle(camera.max_angle).equals(camera)


def test_other_camera_types_are_named(tmp_path: Path) -> None:
    content = basalt("ds")
    content["value0"]["intrinsics"][0]["camera_type"] = "spherical"
    with pytest.raises(
        ValueError, match=r"intrinsics\[0\], camera_type: expected one of ds, eucm, .* got 'spherical'"
    ):
        read_rig(dump(tmp_path / "calibration.json", content))


def test_quaternion_that_is_none_is_refused(tmp_path: Path) -> None:
    content = basalt("ds")
    content["value0"]["T_imu_cam"][0]["qw"] = 0.0
    with pytest.raises(ValueError, match=r"T_imu_cam\[0\]: expected a quaternion of length 1"):
        read_rig(dump(tmp_path / "calibration.json", content))
