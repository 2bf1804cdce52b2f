# SPDX-License-Identifier: Apache-2.0
"""The icosphere: a nearly uniform grid of directions, its topology, and exact point location."""

from sphericalvision.icosphere.icosphere import Icosphere
from sphericalvision.icosphere.locate import locate
from sphericalvision.icosphere.mesh import icosphere_solid_angles, icosphere_vertices
from sphericalvision.icosphere.topology import (
    chart_vertex_ids,
    coarse_vertex_ids,
    icosphere_faces,
    icosphere_neighbors,
    level_from_num_vertices,
    num_icosphere_vertices,
    subdivision_order,
    vertex_at,
)

__all__ = [
    "Icosphere",
    "chart_vertex_ids",
    "coarse_vertex_ids",
    "icosphere_faces",
    "icosphere_neighbors",
    "icosphere_solid_angles",
    "icosphere_vertices",
    "level_from_num_vertices",
    "locate",
    "num_icosphere_vertices",
    "subdivision_order",
    "vertex_at",
]
