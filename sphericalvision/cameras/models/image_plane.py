# SPDX-License-Identifier: Apache-2.0
"""Conversions between pixels, the plane in units of the focal length, and directions, component by component."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Camera, Projection, Unprojection
from sphericalvision.cameras.declaration import Intrinsic
from sphericalvision.geometry.directions import components, from_components


class PlaneCamera(Camera):
    """A model that ends in ``pixels_from_plane``; some have a skew."""

    focal_length: Intrinsic = Intrinsic(2, above=0, unit="pixels", named="fx fy")
    principal_point: Intrinsic = Intrinsic(2, named="cx cy")

    def _project(self, points: Tensor) -> Projection:
        pixels, valid = super()._project(points)
        return Projection(self._skewed(pixels, 1), valid)

    def _unproject(self, pixels: Tensor) -> Unprojection:
        return super()._unproject(self._skewed(pixels, -1))

    def _skewed(self, pixels: Tensor, sign: int) -> Tensor:
        """Pixels whose u grows, or falls, by ``skew`` for each focal length of v."""
        skew: Tensor | None = getattr(self, "skew", None)
        if skew is None:
            return pixels
        focal_length, center, skew = (
            self._align(x, pixels) for x in (self.focal_length, self.principal_point, skew)
        )
        u, v = components(pixels)
        along = (v - center[..., 1]) / focal_length[..., 1]
        return from_components(torch.addcmul(u, skew, along, value=sign), v)


def pixels_from_plane(
    x: Float[Tensor, "*#batch"],
    y: Float[Tensor, "*#batch"],
    focal_length: Float[Tensor, "*#batch #2"],
    principal_point: Float[Tensor, "*#batch 2"],
) -> Float[Tensor, "*batch 2"]:
    """Pixels (*, 2) of (x, y), each (*), in units of the focal length (*, 1 or 2).

    Examples:
        >>> x, y = torch.tensor(0.5), torch.tensor(1.0)
        >>> pixels_from_plane(x, y, torch.tensor([10.0, 20.0]), torch.tensor([100.0, 200.0])).tolist()
        [105.0, 220.0]
    """
    cu, cv = principal_point.unbind(-1)
    return from_components(x * focal_length[..., 0] + cu, y * focal_length[..., -1] + cv)


def plane_from_pixels(
    pixels: Float[Tensor, "*#batch 2"],
    focal_length: Float[Tensor, "*#batch #2"],
    principal_point: Float[Tensor, "*#batch 2"],
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Offsets (x, y), each (*), of ``pixels`` (*, 2) from the principal point in units of the focal length (*, 1 or 2).

    Examples:
        >>> pixels = torch.tensor([105.0, 220.0])
        >>> x, y = plane_from_pixels(pixels, torch.tensor([10.0, 20.0]), torch.tensor([100.0, 200.0]))
        >>> x.item(), y.item()
        (0.5, 1.0)
    """
    (u, v), (cu, cv) = components(pixels), principal_point.unbind(-1)
    return (u - cu) / focal_length[..., 0], (v - cv) / focal_length[..., -1]
