# SPDX-License-Identifier: Apache-2.0
"""Scenes that are rendered, data sets on disk, and transforms of their samples."""

from sphericalvision.data.fivefold import RotateFivefold, rotate_fivefold
from sphericalvision.data.scene_dataset import SceneDataset
from sphericalvision.data.scenes import (
    Scene,
    make_scene,
    ray_depth,
    render_camera,
    render_directions,
    render_rig,
)

__all__ = [
    "RotateFivefold",
    "Scene",
    "SceneDataset",
    "make_scene",
    "ray_depth",
    "render_camera",
    "render_directions",
    "render_rig",
    "rotate_fivefold",
]
