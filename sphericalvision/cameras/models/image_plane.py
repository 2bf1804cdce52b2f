# SPDX-License-Identifier: Apache-2.0
"""Conversions between pixels, the plane in units of the focal length, and directions, component by component."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Projection
from sphericalvision.geometry.directions import components, from_components

__all__ = [
    "IMAGE_PLANE",
    "pixels_from_plane",
    "plane_from_pixels",
    "unit_directions",
    "with_skew",
    "without_skew",
]


IMAGE_PLANE: dict[str, tuple[int, ...]] = {"focal_length": (2,), "principal_point": (2,)}
"""Sizes of the intrinsics of models that end in ``pixels_from_plane``."""


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


def unit_directions(
    x: Float[Tensor, "*#batch"], y: Float[Tensor, "*#batch"], z: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*batch 3"]:
    """(x, y, z), each (*) and not all 0, scaled to unit length, (*, 3).

    Examples:
        >>> unit_directions(torch.tensor(0.0), torch.tensor(0.0), torch.tensor(2.0)).tolist()
        [0.0, 0.0, 1.0]
    """
    shrink = torch.addcmul(torch.addcmul(x * x, y, y), z, z).rsqrt()
    return from_components(x * shrink, y * shrink, z * shrink)


def with_skew(
    projection: Projection,
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    skew: Float[Tensor, "*#batch"] | None,
) -> Projection:
    """A projection whose u grows by ``skew`` (*) pixels for each focal length of v, if there is a skew.

    Examples:
        >>> seen = Projection(torch.tensor([105.0, 220.0]), torch.tensor(True))
        >>> lens = torch.tensor([10.0, 20.0]), torch.tensor([100.0, 200.0]), torch.tensor(0.5)
        >>> with_skew(seen, *lens).pixels.tolist()  # v is one focal length from the principal point
        [105.5, 220.0]
    """
    if skew is None:
        return projection
    u, v = components(projection.pixels)
    along = (v - principal_point[..., 1]) / focal_length[..., 1]
    return Projection(from_components(torch.addcmul(u, skew, along), v), projection.valid)


def without_skew(
    pixels: Float[Tensor, "*#batch 2"],
    focal_length: Float[Tensor, "*#batch 2"],
    principal_point: Float[Tensor, "*#batch 2"],
    skew: Float[Tensor, "*#batch"] | None,
) -> Float[Tensor, "*batch 2"]:
    """The pixels (*, 2) that ``with_skew`` made of others, as they were.

    Examples:
        >>> lens = torch.tensor([10.0, 20.0]), torch.tensor([100.0, 200.0]), torch.tensor(0.5)
        >>> without_skew(torch.tensor([105.5, 220.0]), *lens).tolist()
        [105.0, 220.0]
    """
    if skew is None:
        return pixels
    u, v = components(pixels)
    along = (v - principal_point[..., 1]) / focal_length[..., 1]
    return from_components(torch.addcmul(u, skew, along, value=-1), v)
