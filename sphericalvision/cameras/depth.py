# SPDX-License-Identifier: Apache-2.0
"""Depth along the rays and depth along the optical axis (z)."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.checks import check_image
from sphericalvision.core import check_floating, check_type


def depth_from_z(
    z: Float[Tensor, "*#batch h w"], camera: Camera
) -> tuple[Float[Tensor, "*batch h w"], Bool[Tensor, "*batch h w"]]:
    """Depth along the rays of a depth image that holds z, as most perspective data sets store it.

    Args:
        z: ``(*b, h, w)``, metres along the optical axis.
        camera: camera of the image.

    Returns:
        Metres along each pixel's ray ``(*b, h, w)``, 0 where not valid, and ``valid`` ``(*b, h, w)``: where the camera
        looks, less than 90° from its axis; elsewhere z says nothing about the depth.

    Raises:
        ShapeError: ``z`` is not of the camera's size.

    Examples:
        >>> from sphericalvision.cameras import PinholeCamera
        >>> camera = PinholeCamera([1.0, 1.0], [0.0, 0.0], (1, 2))
        >>> depth, valid = depth_from_z(torch.tensor([[3.0, 3.0]]), camera)
        >>> depth  # the right pixel looks 45° aside
        tensor([[3.0000, 4.2426]])
    """
    directions, valid = _directions(z, camera, "z")
    cosine = directions[..., 2]
    valid = valid & (cosine > torch.finfo(cosine.dtype).eps)
    depth = torch.where(valid, z, 0.0) / torch.where(valid, cosine, 1.0)
    return depth, valid.expand(depth.shape)


def z_from_depth(
    depth: Float[Tensor, "*#batch h w"], camera: Camera
) -> tuple[Float[Tensor, "*batch h w"], Bool[Tensor, "*batch h w"]]:
    """The z coordinate of the points that a depth image along the rays shows: the inverse of ``depth_from_z``.

    Args:
        depth: ``(*b, h, w)``, metres along each pixel's ray.
        camera: camera of the image.

    Returns:
        Metres along the optical axis ``(*b, h, w)``, negative for points behind, 0 where not valid, and ``valid``
        ``(*b, h, w)``: where the camera looks.

    Raises:
        ShapeError: ``depth`` is not of the camera's size.

    Examples:
        >>> from sphericalvision.cameras import PinholeCamera
        >>> camera = PinholeCamera([1.0, 1.0], [0.0, 0.0], (1, 2))
        >>> z, valid = z_from_depth(torch.tensor([[3.0, 2.0**0.5 * 3]]), camera)
        >>> z.round(decimals=4).tolist()
        [[3.0, 3.0]]
    """
    directions, valid = _directions(depth, camera, "depth")
    z = torch.where(valid, depth, 0.0) * directions[..., 2]
    return z, valid.expand(z.shape)


def points_from_depth(
    depth: Float[Tensor, "*#batch h w"], camera: Camera
) -> tuple[Float[Tensor, "*batch h w 3"], Bool[Tensor, "*batch h w"]]:
    """The points that a depth image along the rays shows, in the camera's frame, and where there are any.

    What Kornia's ``depth_to_3d`` is for z and pinholes, for any lens; with z call ``depth_from_z`` first.

    Args:
        depth: ``(*b, h, w)``, metres along each pixel's ray.
        camera: camera of the image.

    Returns:
        Points ``(*b, h, w, 3)``, 0 where not valid, and ``valid`` ``(*b, h, w)``: where the camera looks and the depth
        is a finite number above 0.

    Raises:
        ShapeError: ``depth`` is not of the camera's size.

    Examples:
        >>> from sphericalvision.cameras import EquirectangularCamera
        >>> points, valid = points_from_depth(torch.full((2, 4), 3.0), EquirectangularCamera((2, 4)))
        >>> points.norm(dim=-1).mean().item(), valid.all().item()
        (3.0, True)
    """
    directions, seen = _directions(depth, camera, "depth")
    valid = seen & depth.isfinite() & (depth > 0)
    points = torch.where(valid, depth, 0.0).unsqueeze(-1) * directions
    return points, valid


def _directions(values: Tensor, camera: Camera, name: str) -> tuple[Tensor, Tensor]:
    """Every pixel's direction (*b, h, w, 3), and where the camera looks."""
    check_type("camera", camera, Camera)
    check_image(name, values, camera.image_size, "(*b, h, w)")
    check_floating(name, values)
    height, width = camera.image_size
    pixels = camera.pixel_grid(values.dtype).to(values.device)
    directions, valid = camera.unproject(pixels.expand(*camera.batch_shape, height, width, 2))
    return directions, valid
