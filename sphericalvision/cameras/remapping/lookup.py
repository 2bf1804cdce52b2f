# SPDX-License-Identifier: Apache-2.0
"""Where the pixels of one camera lie in another."""

from __future__ import annotations

from jaxtyping import Bool, Float, Int
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.field_of_view import focal_length_on_axis
from sphericalvision.cameras.model_alone import lifted
from sphericalvision.cameras.models.equirectangular import EquirectangularCamera
from sphericalvision.geometry.directions import broadcast_shapes
from sphericalvision.kernels import full_precision


@full_precision
def source_pixels(
    source: Camera,
    target: Camera,
    rotation: Float[Tensor, "*turns 3 3"] | None,
    positions: Float[Tensor, "*positions 2"],
) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
    """Pixels (*b, *, 2) of the source that show what the target shows at ``positions`` (*, 2), and validity (*b, *).

    Args:
        source: of any batch shape; batch shapes of both cameras and the rotation broadcast to *b.
        target: the camera whose pixels ``positions`` are.
        rotation: (*b, 3, 3), target_from_source.
        positions: (u, v); dtype and device of the answer.
    """
    batch_of_rotation = () if rotation is None else rotation.shape[:-2]
    batch = broadcast_shapes(source.batch_shape, target.batch_shape, batch_of_rotation)
    directions, seen = lifted(target, batch).unproject(positions.expand(*batch, *positions.shape))
    if rotation is not None:
        # target_from_source turns the other way: its transpose acts on column vectors, itself on rows.
        matrices = rotation.to(directions).expand(*batch, 3, 3).reshape(-1, 3, 3)
        directions = (directions.reshape(len(matrices), -1, 3) @ matrices).reshape(directions.shape)
    pixels, visible = lifted(source, batch).project(directions)
    return pixels, seen & visible


def nearest_pixel(camera: Camera, pixels: Float[Tensor, "*batch 2"]) -> Int[Tensor, "*batch"]:
    """Index (*) into the flattened image of the pixel whose centre is nearest to ``pixels`` (*, 2).

    Examples:
        >>> import torch
        >>> nearest_pixel(EquirectangularCamera((4, 8)), torch.tensor([[7.6, 1.2], [2.0, -0.5]])).tolist()
        [8, 2]
    """
    height, width = camera.image_size
    column, row = (pixels.detach() + 0.5).floor().long().unbind(-1)
    column = column.clamp(0, width - 1) if camera.edges == "border" else column % width
    return row.clamp(0, height - 1) * width + column


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
