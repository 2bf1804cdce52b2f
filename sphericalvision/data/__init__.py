# SPDX-License-Identifier: Apache-2.0
"""Scenes that are rendered, data sets on disk, and transforms of their samples."""

from importlib import import_module
from typing import Any

from sphericalvision.data.augmentation.fivefold import RotateFivefold
from sphericalvision.data.augmentation.photometric import PhotometricAugmentation
from sphericalvision.data.augmentation.rotate_fisheye import RotateFisheye
from sphericalvision.data.augmentation.sphere_rotation import random_rotations
from sphericalvision.data.augmentation.sphere_transforms import RandomSphereRotation, RandomYaw
from sphericalvision.data.augmentation.transforms import Compose, RandomShift, ShuffleCameras, ToSphere
from sphericalvision.data.collate import collate_samples
from sphericalvision.data.omnistereo.dataset import OmniStereoDataset
from sphericalvision.data.omnistereo.writer import write_omnistereo
from sphericalvision.io.images import read_image, write_image

__all__ = [
    "Compose",
    "OmniStereoDataset",
    "PhotometricAugmentation",
    "RandomShift",
    "RandomSphereRotation",
    "RandomYaw",
    "RotateFisheye",
    "RotateFivefold",
    "ShuffleCameras",
    "ToSphere",
    "collate_samples",
    "random_rotations",
    "read_image",
    "write_image",
    "write_omnistereo",
]

_MOVED = (
    "FisheyeSceneDataset",
    "MeshScene",
    "SURFACE_LABELS",
    "Scene",
    "SceneDataset",
    "make_scene",
    "mesh_from_scene",
    "ray_depth",
    "ray_labels",
    "read_mesh_scene",
    "render_camera",
    "render_directions",
    "render_rig",
)
"""Names that are in ``sphericalvision.scenes`` since, and may still be asked for here."""


def __getattr__(name: str) -> Any:
    if name in _MOVED:
        return getattr(import_module("sphericalvision.scenes"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
