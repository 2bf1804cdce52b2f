# SPDX-License-Identifier: Apache-2.0
"""Grids of directions and resampling between them and cameras."""

from sphericalvision.icosphere import Icosphere
from sphericalvision.sphere.base import SphereGrid
from sphericalvision.sphere.cube_layouts import CUBE_FACES, CUBE_LAYOUTS, cube_from_layout, cube_to_layout
from sphericalvision.sphere.cubemap import Cubemap, world_from_cube_face
from sphericalvision.sphere.equirectangular import Equirectangular
from sphericalvision.sphere.healpix import Healpix
from sphericalvision.sphere.healpix_pixels import nested_from_ring, ring_from_nested
from sphericalvision.sphere.resample import resample, resample_mask

__all__ = [
    "CUBE_FACES",
    "CUBE_LAYOUTS",
    "Cubemap",
    "Equirectangular",
    "Healpix",
    "Icosphere",
    "SphereGrid",
    "cube_from_layout",
    "cube_to_layout",
    "nested_from_ring",
    "resample",
    "resample_mask",
    "ring_from_nested",
    "world_from_cube_face",
]
