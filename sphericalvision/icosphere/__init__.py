# SPDX-License-Identifier: Apache-2.0
"""The icosphere: a nearly uniform grid of directions, its topology, its levels, and exact point location."""

from sphericalvision.icosphere.adjacency import icosphere_edges, icosphere_neighbors
from sphericalvision.icosphere.areas import (
    icosphere_normals,
    icosphere_solid_angles,
    icosphere_voronoi_solid_angles,
)
from sphericalvision.icosphere.icosphere import Icosphere
from sphericalvision.icosphere.locate import locate
from sphericalvision.icosphere.locator import TriangleLocator
from sphericalvision.icosphere.mesh import icosphere_vertices
from sphericalvision.icosphere.patches import icosphere_rings, icosphere_within
from sphericalvision.icosphere.pooling import (
    IcospherePool,
    IcosphereUpsample,
    icosphere_pool,
    icosphere_upsample,
)
from sphericalvision.icosphere.subdivision import from_subdivision_order, to_subdivision_order
from sphericalvision.icosphere.topology import (
    icosphere_faces,
    level_from_num_vertices,
    num_icosphere_vertices,
)

__all__ = [
    "Icosphere",
    "IcospherePool",
    "IcosphereUpsample",
    "TriangleLocator",
    "from_subdivision_order",
    "icosphere_edges",
    "icosphere_faces",
    "icosphere_neighbors",
    "icosphere_normals",
    "icosphere_pool",
    "icosphere_rings",
    "icosphere_solid_angles",
    "icosphere_upsample",
    "icosphere_vertices",
    "icosphere_voronoi_solid_angles",
    "icosphere_within",
    "level_from_num_vertices",
    "locate",
    "num_icosphere_vertices",
    "to_subdivision_order",
]
