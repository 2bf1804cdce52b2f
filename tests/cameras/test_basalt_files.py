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
    save_camera,
)
from tests.cameras.calibration_samples import (
    assert_projects,
    basalt,
    directions,
    dump,
    opencv_plain,
)

CENTER = (254.96, 256.89)


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
