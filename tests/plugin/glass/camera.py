# SPDX-License-Identifier: Apache-2.0
from typing import ClassVar

import torch

from sphericalvision.cameras import Camera, Projection, Unprojection


class EquisolidLens(Camera):
    """A lens whose pixels cover equal solid angles: r = 2 f sin(theta / 2)."""

    model = "equisolid_lens"
    intrinsic_names = ("focal_length", "principal_point")
    sizes: ClassVar = {"focal_length": (1,), "principal_point": (2,)}

    def __init__(self, focal_length, principal_point, image_size, max_angle=1.9):
        super().__init__(image_size, max_angle, focal_length=focal_length, principal_point=principal_point)

    def _project(self, points):
        x, y, z = torch.nn.functional.normalize(points, dim=-1).unbind(-1)
        scale = self.focal_length * (2 / (1 + z).clamp(min=1e-9)).sqrt()[..., None]
        return Projection(torch.stack((x, y), -1) * scale + self.principal_point, z > -1 + 1e-6)

    def _unproject(self, pixels):
        plane = (pixels - self.principal_point) / self.focal_length
        square = plane.square().sum(-1, keepdim=True) / 4  # sine squared of half the angle
        directions = torch.cat((plane * (1 - square).clamp(min=0).sqrt(), 1 - 2 * square), -1)
        return Unprojection(directions, (square < 1)[..., 0])
