# SPDX-License-Identifier: Apache-2.0
"""Perspective pictures from wide images."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.checks import checked_size
from sphericalvision.cameras.field_of_view import focal_length_on_axis, visible_angle
from sphericalvision.cameras.models.pinhole import PinholeCamera
from sphericalvision.cameras.remapping.remap import remap
from sphericalvision.core import ArgumentError, check_type
from sphericalvision.geometry.directions import broadcast_shapes, holds

_WIDEST = math.radians(80)  # from the axis, of what a perspective picture is asked to show


def undistort(
    image: Shaped[Tensor, "*images C h w"],
    camera: Camera,
    field_of_view: float | None = None,
    focal_length: float | Float[Tensor, " ..."] | None = None,
    image_size: Sequence[int] | None = None,
    rotation: Float[Tensor, "*turns 3 3"] | None = None,
    mode: str = "bilinear",
    balance: float | None = None,
) -> Shaped[Tensor, "*batch C h_out w_out"]:
    """A perspective view from a wide image: ``remap`` to ``undistorted_camera``.

    Args:
        image: ``(*b, c, h, w)`` as taken by ``camera``.
        camera: camera that took the image.
        field_of_view: of the picture from its left to its right edge, radians, below π.
        focal_length: of the view in pixels, instead of a field of view. With neither, the centre of the view has the
            scale of the image.
        image_size: (height, width) of the picture; that of the image if not given.
        rotation: ``(*b, 3, 3)``, from the camera to the view: what the image shows in direction d, the picture shows in
            ``rotation @ d``.
        mode: see ``remap``; ``"area"`` if the picture is smaller than the image.
        balance: instead of a field of view, from 0, the widest view of which the image shows every pixel, to 1, the
            narrowest that shows all of the image; what is more than 80° off the axis, where
            perspective ends, is not asked for.

    Returns:
        ``(*b, c, h', w')``, 0 where the image shows nothing: where
        ``remap_mask(camera, undistorted_camera(...), rotation)`` is False.

    Raises:
        ArgumentError: more than one of field of view, focal length and balance is given, or it is out of range.
        ShapeError: see ``remap``.

    Examples:
        >>> from sphericalvision.cameras import FisheyeCamera
        >>> fisheye = FisheyeCamera.from_field_of_view((64, 64), math.radians(220))
        >>> picture = undistort(torch.ones(3, 64, 64), fisheye, math.radians(90), image_size=(48, 64))
        >>> picture.shape
        torch.Size([3, 48, 64])
    """
    target = undistorted_camera(camera, field_of_view, focal_length, image_size, balance)
    return remap(image, camera, target, rotation, mode)


def undistorted_camera(
    camera: Camera,
    field_of_view: float | None = None,
    focal_length: float | Float[Tensor, " ..."] | None = None,
    image_size: Sequence[int] | None = None,
    balance: float | None = None,
) -> PinholeCamera:
    """The pinhole camera of the picture that ``undistort`` makes with the same arguments.

    Its pixels are square and its principal point is the middle of the picture.

    Raises:
        ArgumentError: see ``undistort``.

    Examples:
        >>> from sphericalvision.cameras import FisheyeCamera
        >>> fisheye = FisheyeCamera.from_field_of_view((64, 64), math.radians(220))
        >>> undistorted_camera(fisheye, math.radians(90), image_size=(48, 64)).focal_length
        tensor([32., 32.])
        >>> [round(undistorted_camera(fisheye, balance=share).focal_length[0].item(), 1) for share in (0, 1)]
        [8.0, 5.6]
    """
    check_type("camera", camera, Camera)
    height, width = camera.image_size if image_size is None else checked_size(image_size)
    if sum(value is not None for value in (field_of_view, focal_length, balance)) > 1:
        raise ArgumentError(
            "field_of_view, focal_length, balance: give one of them, the others follow from the width"
        )
    if balance is not None:
        check_type("balance", balance, (int, float), "from 0, all valid, to 1, all kept")
        if not 0 <= balance <= 1:
            raise ArgumentError(f"balance: expected 0 (every pixel valid) to 1 (all kept), got {balance}")
        valid, whole = _focal_lengths_at_limits(camera, (height, width))
        focal_length = (1 - balance) * valid + balance * whole
    if field_of_view is not None:
        check_type("field_of_view", field_of_view, (int, float), "radians from the left to the right edge")
        if not 0 < field_of_view < math.pi:
            raise ArgumentError(
                f"field_of_view: expected radians in (0, π), got {field_of_view}; a perspective picture ends before "
                "180°, remap to an EquirectangularCamera or FisheyeCamera shows more"
            )
        focal_length = width / 2 / math.tan(field_of_view / 2)
    focal = _scale_on_axis(camera) if focal_length is None else torch.as_tensor(focal_length)
    focal = focal.to(camera.device, camera.dtype)
    if not holds(focal > 0):
        raise ArgumentError(
            f"focal_length: expected positive pixels, got {focal_length}"
            + ("; the camera's image has no scale on its axis to take over" if focal_length is None else "")
        )
    batch = broadcast_shapes(focal.shape, camera.batch_shape)
    center = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=focal.dtype, device=focal.device)
    return PinholeCamera(
        focal.expand(batch).unsqueeze(-1).repeat_interleave(2, -1), center.expand(*batch, 2), (height, width)
    )


def _focal_lengths_at_limits(camera: Camera, image_size: tuple[int, int]) -> tuple[float, float]:
    """Focal length of the widest picture that is valid everywhere, and of the narrowest that shows all of the image."""
    half_height, half_width = image_size[0] / 2, image_size[1] / 2
    height, width = camera.image_size
    corners = torch.tensor([(u, v) for u in (-0.5, width - 0.5) for v in (-0.5, height - 0.5)])
    directions = camera.unproject(corners.to(camera.device, torch.float64)).directions
    azimuth = torch.atan2(directions[:, 1], directions[:, 0])
    corner = torch.tensor([(y, x) for y in (-half_height, half_height) for x in (-half_width, half_width)])
    even = torch.arange(720, dtype=torch.float64) * (math.pi / 360)
    azimuth = torch.cat((azimuth, torch.atan2(*corner.double().T).to(azimuth), even.to(azimuth)))
    radius = visible_angle(camera, azimuth).clamp_max(_WIDEST).tan()
    to_border = (half_width / azimuth.cos().abs()).minimum(half_height / azimuth.sin().abs())
    focal = to_border / radius.clamp_min(1e-9)  # with which the picture's border is the image's, there
    return float(focal.max()), float(focal.min())


def _scale_on_axis(camera: Camera) -> Tensor:
    """Pixels a radian (*b,) around the optical axis: the geometric mean of both directions."""
    if camera.batch_shape:
        return torch.stack([_scale_on_axis(camera.select(index)) for index in range(camera.batch_shape[0])])
    return focal_length_on_axis(camera).prod(-1).sqrt()
