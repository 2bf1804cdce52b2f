# SPDX-License-Identifier: Apache-2.0
"""Rigs that scenes are rendered through."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from sphericalvision.cameras import CameraRig, FisheyeCamera
from sphericalvision.core import ArgumentError
from sphericalvision.geometry import directions_from_longitude_latitude, transform_from_axis_angle

__all__ = ["ring_rig"]


def ring_rig(
    num_cameras: int = 4,
    radius: float = 0.2,
    image_size: Sequence[int] = (320, 320),
    field_of_view_deg: float = 220.0,
    projection: str = "equidistant",
) -> CameraRig:
    """Cameras on a horizontal ring that look outwards, the first one forward, then clockwise seen from above.

    With the default numbers this is the rig of OmniThings (front, right, back, left), centred on the origin.

    Args:
        num_cameras: how many, evenly around the ring.
        radius: metres from the centre to each camera.
        image_size: (height, width) in pixels; the image circle fills the shorter side.
        field_of_view_deg: full angle of each fisheye in degrees.
        projection: of the fisheye: "equidistant", "equisolid", "stereographic" or "orthographic".

    Examples:
        >>> ring_rig(4).world_from_camera[1, :3, 3]  # the second camera stands to the right, on +x
        tensor([0.2000, 0.0000, 0.0000])
    """
    if num_cameras < 2 or radius <= 0:
        raise ArgumentError(
            f"ring rig: expected 2 or more cameras and radius > 0, got {num_cameras} and {radius}"
        )
    height, width = image_size
    camera = FisheyeCamera.from_field_of_view(
        (int(height), int(width)), math.radians(field_of_view_deg), projection=projection
    )
    longitude = torch.arange(num_cameras, dtype=torch.float64) * (2 * math.pi / num_cameras)
    zero = torch.zeros_like(longitude)
    position = radius * directions_from_longitude_latitude(longitude, zero)
    turn = torch.stack([zero, longitude, zero], -1)
    return CameraRig(
        {f"cam{i + 1}": camera for i in range(num_cameras)},
        transform_from_axis_angle(turn, position).round(decimals=12).to(torch.get_default_dtype()),
    )
