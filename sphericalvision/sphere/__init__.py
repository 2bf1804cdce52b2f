# SPDX-License-Identifier: Apache-2.0
"""Grids of directions and resampling between them and cameras."""

from sphericalvision.sphere.convolutions.padding import (
    CubePad2d,
    EquirectangularPad2d,
    cube_pad,
    equirectangular_pad,
)
from sphericalvision.sphere.convolutions.seamless import make_seamless
from sphericalvision.sphere.convolutions.sphere_conv import SphereConv2d, sphere_conv2d
from sphericalvision.sphere.convolutions.tangent_taps import sphere_taps
from sphericalvision.sphere.grids.base import SphereGrid
from sphericalvision.sphere.grids.cube_layouts import cube_from_layout, cube_to_layout
from sphericalvision.sphere.grids.cubemap import Cubemap
from sphericalvision.sphere.grids.equirectangular import Equirectangular
from sphericalvision.sphere.grids.healpix import Healpix
from sphericalvision.sphere.grids.healpix_pixels import nested_from_ring, ring_from_nested
from sphericalvision.sphere.grids.healpix_pyramid import healpix_pool, healpix_upsample
from sphericalvision.sphere.grids.tangent import TangentImages
from sphericalvision.sphere.resampling.resample import Resample, resample, resample_mask

__all__ = [
    "CubePad2d",
    "Cubemap",
    "Equirectangular",
    "EquirectangularPad2d",
    "Healpix",
    "Resample",
    "SphereConv2d",
    "SphereGrid",
    "TangentImages",
    "cube_from_layout",
    "cube_pad",
    "cube_to_layout",
    "equirectangular_pad",
    "healpix_pool",
    "healpix_upsample",
    "make_seamless",
    "nested_from_ring",
    "resample",
    "resample_mask",
    "ring_from_nested",
    "sphere_conv2d",
    "sphere_taps",
]
