# SPDX-License-Identifier: Apache-2.0
"""Files of a depth estimate hold what the cameras saw."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
import trimesh

from sphericalvision.cameras import ring_rig
from sphericalvision.recipes.app.results import DepthResult, save_result
from sphericalvision.sphere import Equirectangular


def test_points_that_no_camera_sees_are_not_in_the_cloud(tmp_path: Path) -> None:
    """One camera looks forward; a network says something about what is behind it, too."""
    rig = ring_rig(2, field_of_view=math.radians(120), image_size=(64, 64)).subset([0])
    grid = Equirectangular(32, 64)
    directions = grid.directions.flatten(0, 1)
    result = DepthResult(
        directions=directions,
        index=torch.full((len(directions),), 8.0),
        inverse_depth=torch.full((len(directions),), 0.5),
        confidence=torch.ones(len(directions)),
        seen=torch.ones(len(directions), dtype=torch.bool),
        panorama=torch.full((32, 64), 2.0),
        matched=torch.ones(32, 64, dtype=torch.bool),
        min_depth=0.5,
        max_depth=10.0,
    )
    save_result(tmp_path, "", result, {name: torch.rand(3, 64, 64) for name in rig.names}, rig)
    points = torch.from_numpy(np.asarray(trimesh.load(tmp_path / "points.ply").vertices)).float() - rig.center
    angles = torch.atan2(points[:, :2].norm(dim=1), points[:, 2])
    assert angles.max() < math.radians(61)
    seen = np.load(tmp_path / "depth.npz")["seen_panorama"]
    assert len(points) == seen.sum() < seen.size
