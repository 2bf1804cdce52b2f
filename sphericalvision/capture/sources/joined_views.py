# SPDX-License-Identifier: Apache-2.0
"""Pictures that hold the views of all cameras in rows and columns, as of 360 cameras and of devices with one stream."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from sphericalvision.cameras import CameraRig, FisheyeCamera
from sphericalvision.core import ArgumentError


def split_views(image: Any, rig: CameraRig) -> dict[str, Any]:
    """Cut a picture ``(h, w, ...)``, an array or a tensor, with the views of all cameras in rows and
    columns, in the order of the rig.

    Examples:
        >>> import numpy as np
        >>> from sphericalvision.cameras import ring_rig
        >>> views = split_views(np.zeros((16, 80, 3), np.uint8), ring_rig(4, image_size=(16, 20)))
        >>> list(views), views["cam4"].shape
        (['cam1', 'cam2', 'cam3', 'cam4'], (16, 20, 3))
    """
    rows, columns = views_layout((image.shape[0], image.shape[1]), rig)
    height, width = image.shape[0] // rows, image.shape[1] // columns
    corners = [(row * height, column * width) for row in range(rows) for column in range(columns)]
    views = (image[y : y + height, x : x + width] for y, x in corners)
    return dict(zip(rig.names, views, strict=True))


def size_of_view(size: Sequence[int], rig: CameraRig) -> tuple[int, int]:
    """Height and width of a view in a picture of this size.

    Raises:
        ArgumentError: no arrangement has views of the shape of the cameras' images.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> size_of_view((32, 40), ring_rig(4, image_size=(16, 20)))
        (16, 20)
    """
    rows, columns = views_layout(size, rig)
    return size[0] // rows, size[1] // columns


def views_layout(size: Sequence[int], rig: CameraRig) -> tuple[int, int]:
    """Rows and columns in which n views fill a picture, told by the shape of the cameras' images.

    Raises:
        ArgumentError: no arrangement has views of that shape.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> views_layout((32, 40), ring_rig(4, image_size=(16, 20)))
        (2, 2)
    """
    number = len(rig)
    expected = {camera.image_size for camera in rig.cameras.values()}
    for rows in range(1, number + 1):
        columns = number // rows
        if rows * columns == number and size[0] % rows == 0 and size[1] % columns == 0:
            height, width = size[0] // rows, size[1] // columns
            if all(abs(height * w - width * h) <= 0.01 * height * w for h, w in expected):
                return rows, columns
    shapes = " or ".join(f"{width} x {height}" for height, width in sorted(expected))
    raise ArgumentError(
        f"images: a picture of {size[1]} x {size[0]} (width x height) does not hold {number} views of the shape "
        f"{shapes} in rows and columns"
    )


def rig_of_views(names: Sequence[str], size: Sequence[int]) -> CameraRig:
    """Stand-ins for cameras without a calibration: their views fill a picture, as nearly square as they can.

    Raises:
        ArgumentError: so many views do not fill it.

    Examples:
        >>> rig_of_views(["front", "back"], (960, 1920)).cameras["back"].image_size
        (960, 960)
    """
    number = len(names)
    views = [
        (size[0] // rows, size[1] * rows // number)
        for rows in range(1, number + 1)
        if number % rows == 0 and size[0] % rows == 0 and size[1] % (number // rows) == 0
    ]
    if not views:
        raise ArgumentError(
            f"cameras: {number} views in rows and columns do not fill a picture of {size[1]} x {size[0]} pixels"
        )
    view = min(views, key=lambda shape: abs(math.log(shape[0] / shape[1])))
    camera = FisheyeCamera.from_field_of_view(view, math.pi)
    return CameraRig(dict.fromkeys(names, camera), torch.eye(4).repeat(number, 1, 1))
