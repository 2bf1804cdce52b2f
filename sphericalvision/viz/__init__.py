# SPDX-License-Identifier: Apache-2.0
"""Pictures, point clouds and meshes of what the rest of the package computes."""

from sphericalvision.viz.cameras import angle_map
from sphericalvision.viz.color import depth_to_color, error_to_color
from sphericalvision.viz.crown import crown_picture
from sphericalvision.viz.figure import sheet
from sphericalvision.viz.mesh import icosphere_mesh, sphere_mesh
from sphericalvision.viz.panorama import (
    depth_panorama,
    error_panorama,
    rgb_panorama,
)
from sphericalvision.viz.pointcloud import panorama_point_cloud, save_point_cloud
from sphericalvision.viz.rigs import coverage_panorama, rig_picture

__all__ = [
    "angle_map",
    "coverage_panorama",
    "crown_picture",
    "depth_panorama",
    "depth_to_color",
    "error_panorama",
    "error_to_color",
    "icosphere_mesh",
    "panorama_point_cloud",
    "rgb_panorama",
    "rig_picture",
    "save_point_cloud",
    "sheet",
    "sphere_mesh",
]
