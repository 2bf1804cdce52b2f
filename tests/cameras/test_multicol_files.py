# SPDX-License-Identifier: Apache-2.0
"""MultiCol-SLAM's YAML (Lafida): order of the coefficients, the affine part on (x, y), and Cayley poses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sphericalvision.cameras import OCamCamera, read_camera, read_rig
from sphericalvision.core import MissingFileError
from tests.cameras.calibration_samples import (
    MULTICOL_C,
    MULTICOL_D,
    MULTICOL_E,
    assert_projects,
    directions,
    dump,
    multicol,
    multicol_system,
)


def write(path: Path, content: dict[str, Any]) -> Path:
    dump(path, content)
    path.write_text(f"%YAML:1.0\n\n# Camera Parameters\n{path.read_text()}")
    return path


def ascending(content: dict[str, Any], name: str, value: np.ndarray) -> np.ndarray:
    powers = range(sum(f"Camera.{name}{power}" in content for power in range(30)))
    return np.asarray(sum(content[f"Camera.{name}{power}"] * value**power for power in powers))


def test_world_to_image_is_multicol_s(tmp_path: Path) -> None:
    content = multicol()
    camera = read_camera(write(tmp_path / "InteriorOrientationFisheye0.yaml", content), dtype=torch.float64)
    assert type(camera) is OCamCamera
    assert camera.image_size == (480, 754)
    rays = directions(80.0)[12:]  # the axis apart: there its formula divides by 0
    x, y, z = rays.T
    norm = np.hypot(x, y)
    rho = ascending(content, "pol", np.arctan(-z / norm))
    xx, yy = x / norm * rho, y / norm * rho
    u = MULTICOL_C * xx + MULTICOL_D * yy + 392.2
    v = MULTICOL_E * xx + yy + 243.5
    assert_projects(camera, np.stack((u, v), -1), rays)


def test_image_to_world_is_multicol_s(tmp_path: Path) -> None:
    content = multicol()
    camera = read_camera(write(tmp_path / "camera.yaml", content), dtype=torch.float64)
    pixels = camera.pixel_grid(torch.float64)[::60, ::50].reshape(-1, 2)
    u, v = (pixels.numpy() - [392.2, 243.5]).T
    determinant = MULTICOL_C - MULTICOL_D * MULTICOL_E
    x = (u - MULTICOL_D * v) / determinant
    y = (-MULTICOL_E * u + MULTICOL_C * v) / determinant
    expected = np.stack((x, y, -ascending(content, "a", np.hypot(x, y))), -1)
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    np.testing.assert_allclose(camera.unproject(pixels).directions, expected, rtol=0, atol=1e-13)


def test_system_of_cameras_is_a_rig(tmp_path: Path) -> None:
    for index in (0, 1):
        write(tmp_path / f"InteriorOrientationFisheye{index}.yaml", multicol())
    write(tmp_path / "MultiCamSys_Calibration.yaml", multicol_system())
    for path in (tmp_path, tmp_path / "MultiCamSys_Calibration.yaml"):
        rig = read_rig(path)
        assert rig.names == ["cam1", "cam2"]
        torch.testing.assert_close(rig.axes, torch.tensor([[0.0, 0, 1], [1, 0, 0]]), rtol=0, atol=1e-6)
        torch.testing.assert_close(rig.positions, torch.tensor([[0.0, 0, 0.1], [0.1, 0, 0]]))


def test_missing_camera_of_a_system_is_named(tmp_path: Path) -> None:
    write(tmp_path / "InteriorOrientationFisheye0.yaml", multicol())
    write(tmp_path / "MultiCamSys_Calibration.yaml", multicol_system())
    with pytest.raises(MissingFileError, match=r"InteriorOrientationFisheye1\.yaml: no such file"):
        read_rig(tmp_path)


def test_keys_without_a_space_before_their_value_are_read(tmp_path: Path) -> None:
    """As in files that MultiCol-SLAM publishes: ``Camera.a0:-209.07``, which is no pair to YAML."""
    path = write(tmp_path / "spaced.yaml", multicol())
    tight = tmp_path / "InteriorOrientationFisheye1.yaml"
    tight.write_text(path.read_text().replace(": ", ":"))
    assert "Camera.a0:-" in tight.read_text()
    assert read_camera(tight).equals(read_camera(path))
