# SPDX-License-Identifier: Apache-2.0
"""Scenes that are rendered, data sets on disk, and transforms of their samples."""

from importlib import import_module
from typing import Any

from lazy_loader import attach_stub

_own, __dir__, __all__ = attach_stub(__name__, __file__)
__all__ += ["read_image", "write_image"]

_MOVED = dict.fromkeys(("read_image", "write_image"), "sphericalvision.io.images") | dict.fromkeys(
    (
        "MeshScene",
        "SURFACE_LABELS",
        "Scene",
        "SceneDataset",
        "make_scene",
        "ray_depth",
        "ray_labels",
        "read_mesh_scene",
        "render_camera",
        "render_directions",
        "render_rig",
    ),
    "sphericalvision.scenes",
)
"""Names that may be asked for here, and where they are."""


def __getattr__(name: str) -> Any:
    return getattr(import_module(_MOVED[name]), name) if name in _MOVED else _own(name)
