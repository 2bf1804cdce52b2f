# SPDX-License-Identifier: Apache-2.0
"""Grids of directions and resampling between them and cameras."""

from sphericalvision.icosphere import Icosphere
from sphericalvision.sphere.base import SphereGrid
from sphericalvision.sphere.equirectangular import Equirectangular
from sphericalvision.sphere.resample import resample, resample_mask

__all__ = ["Equirectangular", "Icosphere", "SphereGrid", "resample", "resample_mask"]
