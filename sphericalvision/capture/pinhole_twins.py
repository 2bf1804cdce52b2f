# SPDX-License-Identifier: Apache-2.0
"""Pinhole cameras that stand where a wide one stands, for programs that know no other: faces of a cube."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras import Camera, PinholeCamera, Remap
from sphericalvision.cameras.field_of_view import visible_angle
from sphericalvision.cameras.remapping.lookup import pixels_a_radian
from sphericalvision.cameras.remapping.undistort import undistorted_camera
from sphericalvision.sphere.grids.cube_layouts import CUBE_FACES, world_from_cube_face

NARROW = math.radians(65)
"""Half a field of view that one pinhole holds, whose border is then 5.6 times as fine as its middle."""
LEAST = 0.1
"""Share of a face that its camera sees; others are left out."""


class PinholeTwin(NamedTuple):
    """A pinhole that looks from where its original stands.

    Attributes:
        name: of the face of a cube around the original's axis; empty where one pinhole holds all.
        camera: the pinhole; its principal point is in the middle.
        pose: ``(4, 4)``, original from twin.
        remap: from images of the original to those of the twin; ``remap.mask()`` is where these show something.
    """

    name: str
    camera: PinholeCamera
    pose: Float[Tensor, "4 4"]
    remap: Remap


def pinhole_twins(camera: Camera) -> list[PinholeTwin]:
    """Return pinholes that together see what a camera sees, about as fine as it is in its middle.

    One where it sees no more than 65° from its axis, else the faces of a cube of which it sees a tenth or more: five
    of a fisheye, six of a panorama. A pinhole is its own twin.

    Examples:
        >>> from sphericalvision.cameras import FisheyeCamera
        >>> fisheye = FisheyeCamera.from_field_of_view((64, 64), math.radians(200))
        >>> [(twin.name, twin.camera.image_size) for twin in pinhole_twins(fisheye)][:2]
        [('front', (38, 38)), ('right', (38, 38))]
    """
    widest = float(visible_angle(camera, torch.arange(64, dtype=torch.float64) * (math.pi / 32)).max())
    faces = zip(CUBE_FACES, world_from_cube_face(torch.float64), strict=True)
    if isinstance(camera, PinholeCamera):
        views = {"": (camera, torch.eye(3, dtype=torch.float64))}
    elif widest <= NARROW:
        views = {"": (undistorted_camera(camera, balance=1.0), torch.eye(3, dtype=torch.float64))}
    else:
        side = 2 * math.ceil(pixels_a_radian(camera))
        face = PinholeCamera.from_field_of_view((side, side), math.pi / 2)
        views = {name: (face, turn) for name, turn in faces}
    twins = []
    for name, (view, turn) in views.items():
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = turn
        twin = PinholeTwin(name, view, pose, Remap(camera, view, turn.mT, "area"))
        if not name or twin.remap.mask().float().mean() >= LEAST:
            twins.append(twin)
    return twins
