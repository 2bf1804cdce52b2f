# SPDX-License-Identifier: Apache-2.0
"""Images of a rig's cameras looked up in directions of the world."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.models.equirectangular import EquirectangularCamera
from sphericalvision.cameras.remapping.area import as_floats, block_means
from sphericalvision.cameras.remapping.lookup import pixels_a_radian
from sphericalvision.cameras.rig import CameraRig, check_images_of
from sphericalvision.core import ArgumentError
from sphericalvision.geometry.image_lookup import image_lookup


class SphereLookup(NamedTuple):
    """Where directions fall in the image of one camera: made once, it serves all images of the camera."""

    image_size: tuple[int, int]
    """(height, width) of the images."""
    seen: Tensor
    """``(*b, V)``: within the field of view, the image and the mask."""
    shrink: int
    """Side of the squares of pixels that are averaged first."""
    places: nn.Module
    """Positions in the averaged image; zero is found where nothing is seen."""

    def __call__(self, image: Tensor, fill: float = 0.5) -> Tensor:
        """Values ``(*b, c, V)`` of an image ``(*b, c, h, w)``, ``fill`` where nothing is seen."""
        values: Tensor = self.places(self.averaged(image))
        return values if fill == 0 else torch.where(self.seen.unsqueeze(-2), values, fill)

    def averaged(self, image: Tensor) -> Tensor:
        """The image ``(*b, c, h, w)`` that ``places`` are positions in; of bytes in [0, 1]."""
        return as_floats(image) if self.shrink == 1 else block_means(image, self.shrink)


def sphere_lookups(
    rig: CameraRig, directions: Float[Tensor, "V 3"], antialias: bool = False
) -> list[SphereLookup]:
    """Where directions ``(V, 3)`` of the world, at infinity, fall in the images of a rig's cameras, in order.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> front, *_ = sphere_lookups(ring_rig(4, image_size=(64, 64)), torch.tensor([[0.0, 0.0, 1.0]]))
        >>> front.seen, front(torch.ones(3, 64, 64)).shape
        (tensor([True]), torch.Size([3, 1]))
    """
    seen_from = rig.project_along(directions, directions.new_zeros(1))
    lookups = []
    for index, camera in enumerate(rig.cameras.values()):
        pixels, seen = seen_from.pixels[..., index, 0, :, :], seen_from.valid[..., index, 0, :]
        shrink = _shrinking(camera, directions) if antialias else 1
        small = (-(-camera.image_size[0] // shrink), -(-camera.image_size[1] // shrink))
        positions = ((pixels + 0.5) / shrink - 0.5).unsqueeze(-2)
        lookup = image_lookup(positions, seen.unsqueeze(-1), small, edges=camera.edges)
        lookups.append(SphereLookup(camera.image_size, seen, shrink, lookup))
    return lookups


def sample_sphere(
    rig: CameraRig,
    images: Mapping[str, Float[Tensor, "*#batch c _ _"]] | Sequence[Float[Tensor, "*#batch c _ _"]],
    directions: Float[Tensor, "V 3"],
    fill: float = 0.5,
    antialias: bool = False,
) -> tuple[Float[Tensor, "*batch n c V"], Bool[Tensor, "*seen n V"]]:
    """Look each camera's image up in directions of the world, as if from its own position (rotation only).

    Args:
        rig: one, or a batch of rigs.
        images: by camera name, or in the rig's order: ``(*b, c, h, w)``, as large as the camera is calibrated for.
        directions: ``(V, 3)`` in the world, so that up is up in every result.
        fill: value outside of the field of view, the image or the mask.
        antialias: average pixels first where the image is finer than the directions, taken as evenly spread.

    Returns:
        Values ``(*b, n, c, V)`` and validity ``(*b, n, V)`` (without ``*b`` for a rig shared by the batch).

    Raises:
        ArgumentError: if the number or the names of the images are not those of the rig.
        ShapeError: if an image has another size than its camera.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(4, image_size=(64, 64))
        >>> values, valid = sample_sphere(rig, [torch.ones(3, 64, 64)] * 4, torch.tensor([[0.0, 0.0, 1.0]]))
        >>> values.shape, valid[:, 0].tolist()  # only the back camera does not see what is in front
        (torch.Size([4, 3, 1]), [True, True, False, True])
    """
    values, lookups = [], sphere_lookups(rig, directions, antialias)
    for image, lookup in zip(images_in_order(rig, images), lookups, strict=True):
        values.append(lookup(image, fill))
    return torch.stack(values, -3), torch.stack([lookup.seen for lookup in lookups], -2)


def images_in_order(rig: CameraRig, images: Mapping[str, Tensor] | Sequence[Tensor]) -> list[Tensor]:
    """An image of each camera in the rig's order, given so or by name; raise as ``check_images_of`` does."""
    if not isinstance(images, Mapping):
        if len(images) != len(rig):
            raise ArgumentError(f"images: expected {len(rig)}, one for each camera, got {len(images)}")
        images = dict(zip(rig.names, images, strict=True))
    check_images_of(rig, images)
    return [images[name] for name in rig.names]


def _shrinking(camera: Camera, directions: Tensor) -> int:
    """How many pixels in a row lie between neighbouring directions, on average, at least 1."""
    spacing = math.sqrt(4 * math.pi / directions.shape[-2])
    if isinstance(camera, EquirectangularCamera):
        return max(1, int(spacing * pixels_a_radian(camera)))
    # The image circle fills the shorter side
    pixel = 2 * float(camera.max_angle.max()) / min(camera.image_size)
    return max(1, int(spacing / pixel))
