# SPDX-License-Identifier: Apache-2.0
"""How fine a camera's image is in angle."""

from __future__ import annotations

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.field_of_view import focal_length_on_axis
from sphericalvision.cameras.models.equirectangular import EquirectangularCamera

__all__ = ["pixels_a_radian"]


def pixels_a_radian(camera: Camera) -> float:
    """Return pixels a radian on the optical axis, in the finer direction; of panoramas along the equator.

    Examples:
        >>> import math
        >>> pixels_a_radian(EquirectangularCamera((180, 360))) * math.pi / 180  # a degree
        1.0
    """
    if isinstance(camera, EquirectangularCamera):
        return camera.image_size[1] / (camera.longitudes[1] - camera.longitudes[0])
    return float(focal_length_on_axis(camera).max())
