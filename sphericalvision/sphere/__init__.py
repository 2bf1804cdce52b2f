# SPDX-License-Identifier: Apache-2.0
"""Grids of directions and resampling between them and cameras."""

from sphericalvision.icosphere import Icosphere
from sphericalvision.sphere.band import EquirectangularBand
from sphericalvision.sphere.base import SphereGrid
from sphericalvision.sphere.cube_layouts import CUBE_FACES, CUBE_LAYOUTS, cube_from_layout, cube_to_layout
from sphericalvision.sphere.cubemap import Cubemap, world_from_cube_face
from sphericalvision.sphere.equirectangular import Equirectangular
from sphericalvision.sphere.healpix import Healpix
from sphericalvision.sphere.healpix_pixels import nested_from_ring, ring_from_nested
from sphericalvision.sphere.padding import CubePad2d, EquirectangularPad2d, cube_pad, equirectangular_pad
from sphericalvision.sphere.resample import RESAMPLE_MODES, Resample, resample, resample_mask
from sphericalvision.sphere.seamless import PaddedConv2d, make_circular
from sphericalvision.sphere.sphere_conv import SphereConv2d, sphere_conv2d
from sphericalvision.sphere.tangent import TangentImages
from sphericalvision.sphere.tangent_taps import sphere_taps

__all__ = [
    "CUBE_FACES",
    "CUBE_LAYOUTS",
    "RESAMPLE_MODES",
    "CubePad2d",
    "Cubemap",
    "Equirectangular",
    "EquirectangularBand",
    "EquirectangularPad2d",
    "Healpix",
    "Icosphere",
    "PaddedConv2d",
    "Resample",
    "SphereConv2d",
    "SphereGrid",
    "TangentImages",
    "cube_from_layout",
    "cube_pad",
    "cube_to_layout",
    "equirectangular_pad",
    "make_circular",
    "nested_from_ring",
    "resample",
    "resample_mask",
    "ring_from_nested",
    "sphere_conv2d",
    "sphere_taps",
    "world_from_cube_face",
]
