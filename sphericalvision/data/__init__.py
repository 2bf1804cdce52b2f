# SPDX-License-Identifier: Apache-2.0
"""Scenes that are rendered, data sets on disk, and transforms of their samples."""

from sphericalvision.data.augmentation.fivefold import RotateFivefold
from sphericalvision.data.augmentation.photometric import PhotometricAugmentation
from sphericalvision.data.augmentation.rotate_fisheye import RotateFisheye
from sphericalvision.data.augmentation.sphere_rotation import random_rotations
from sphericalvision.data.augmentation.sphere_transforms import RandomSphereRotation, RandomYaw
from sphericalvision.data.augmentation.transforms import Compose, RandomShift, ShuffleCameras, ToSphere
from sphericalvision.data.collate import collate_samples
from sphericalvision.data.omnistereo.dataset import OmniStereoDataset
from sphericalvision.data.omnistereo.writer import write_omnistereo
from sphericalvision.data.rendering.mesh_scene import MeshScene, read_mesh_scene
from sphericalvision.data.rendering.render import ray_labels
from sphericalvision.data.rendering.to_mesh import mesh_from_scene
from sphericalvision.data.scene_dataset import FisheyeSceneDataset, SceneDataset
from sphericalvision.data.scenes.labels import SURFACE_LABELS
from sphericalvision.data.scenes.recipes import (
    Scene,
    make_scene,
    ray_depth,
    render_camera,
    render_directions,
    render_rig,
)
from sphericalvision.io.images import read_image, write_image

__all__ = [
    "SURFACE_LABELS",
    "Compose",
    "FisheyeSceneDataset",
    "MeshScene",
    "OmniStereoDataset",
    "PhotometricAugmentation",
    "RandomShift",
    "RandomSphereRotation",
    "RandomYaw",
    "RotateFisheye",
    "RotateFivefold",
    "Scene",
    "SceneDataset",
    "ShuffleCameras",
    "ToSphere",
    "collate_samples",
    "make_scene",
    "mesh_from_scene",
    "random_rotations",
    "ray_depth",
    "ray_labels",
    "read_image",
    "read_mesh_scene",
    "render_camera",
    "render_directions",
    "render_rig",
    "write_image",
    "write_omnistereo",
]
