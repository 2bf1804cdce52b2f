# SPDX-License-Identifier: Apache-2.0
"""Basalt's json: its camera types, and writing them with poses and masks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from sphericalvision.cameras import (
    BrownConradyCamera,
    read_camera,
    read_rig,
    save_camera,
)
from sphericalvision.io.images import write_mask
from tests.cameras.calibration_samples import (
    assert_projects,
    basalt,
    directions,
    dump,
    opencv_plain,
)

CENTER = (254.96, 256.89)


def test_a_camera_sees_as_far_as_its_mask(tmp_path: Path) -> None:
    mask = torch.zeros(512, 512, dtype=torch.bool)
    mask[134:376, 150:350] = True
    (tmp_path / "cam0").mkdir()
    write_mask(tmp_path / "cam0" / "mask.png", mask)
    rig = read_rig(dump(tmp_path / "calibration.json", basalt("ds", "kb4")), dtype=torch.float64)
    assert rig.names == ["cam0", "cam1"]
    assert torch.equal(rig.masks["cam0"], mask)
    corners = torch.cartesian_prod(torch.tensor([150.0, 349.0]), torch.tensor([134.0, 375.0])).double()
    directions = rig.cameras["cam0"].unproject(corners).directions
    widest = torch.atan2(directions[:, :2].norm(dim=-1), directions[:, 2]).max()
    torch.testing.assert_close(rig.max_angles[0], widest)
    assert read_rig(tmp_path, max_angle=1.0).max_angles.tolist() == [1.0, 1.0]


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
