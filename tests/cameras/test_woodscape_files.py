# SPDX-License-Identifier: Apache-2.0
"""WoodScape's json: the polynomial, the principal point, the quaternion, and four files as one rig."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from sphericalvision.cameras import RadialPolynomialCamera, read_camera, read_rig
from tests.cameras.calibration_samples import assert_projects, directions, dump, woodscape


def projected(rays: np.ndarray) -> np.ndarray:
    """The equations of the data set's calibration_readme.txt, with the sample's numbers."""
    x, y, z = rays.T
    chi = np.hypot(x, y)
    theta = np.arctan2(chi, z)
    rho = 339.7 * theta - 32.0 * theta**2 + 48.3 * theta**3 - 7.2 * theta**4
    scale = rho / np.where(chi > 0, chi, 1)
    return np.stack((x * scale + 3.9 + 1280 / 2 - 0.5, y * scale * 1.01 - 3.1 + 966 / 2 - 0.5), -1)


def test_projection_is_the_readme_s_past_90_degrees(tmp_path: Path) -> None:
    camera = read_camera(dump(tmp_path / "00001_FV.json", woodscape()), dtype=torch.float64)
    assert type(camera) is RadialPolynomialCamera
    assert camera.image_size == (966, 1280)
    rays = directions(95.0)
    assert_projects(camera, projected(rays), rays)


def test_convention_woodscape_principal_point_is_offset_from_the_middle(tmp_path: Path) -> None:
    """Without offsets it is the middle of the image, (w - 1) / 2 where the first pixel's centre is 0."""
    path = dump(tmp_path / "FV.json", woodscape(cx_offset=0.0, cy_offset=0.0))
    assert read_camera(path).principal_point.tolist() == [639.5, 482.5]


def test_pose_is_camera_to_vehicle(tmp_path: Path) -> None:
    """The sample's front camera looks along the vehicle's x, and its down is the vehicle's -z."""
    rig = read_rig(dump(tmp_path / "FV.json", woodscape()), dtype=torch.float64)
    assert rig.names == ["FV"]
    assert rig.positions[0].tolist() == [3.75, 0.0, 0.66]
    expected = torch.tensor(
        [[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]], dtype=torch.float64
    )  # columns: right, down, forward
    torch.testing.assert_close(rig.world_from_camera[0, :3, :3], expected)


def test_files_of_one_moment_are_a_rig(tmp_path: Path) -> None:
    for name in ("FV", "RV", "MVL", "MVR"):
        dump(tmp_path / f"00001_{name}.json", woodscape(name))
    assert read_rig(tmp_path).names == ["FV", "MVL", "MVR", "RV"]
    dump(tmp_path / "00002_FV.json", woodscape("FV"))
    with pytest.raises(ValueError, match=r"a second camera named 'FV' \(the first is in 00001_FV\.json\)"):
        read_rig(tmp_path)


def test_without_pose_it_is_a_camera(tmp_path: Path) -> None:
    content = woodscape()
    del content["extrinsic"]
    path = dump(tmp_path / "FV.json", content)
    assert type(read_camera(path)) is RadialPolynomialCamera
    with pytest.raises(ValueError, match="without poses"):
        read_rig(path)
    with pytest.raises(ValueError, match="no pose of this camera"):
        read_rig(tmp_path)
