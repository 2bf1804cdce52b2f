# SPDX-License-Identifier: Apache-2.0
"""Images of one camera as another would have taken them from the same place."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.remapping.tables import REMAP_MODES, Remapped, RemapTables

__all__ = ["REMAP_MODES", "Remap", "Remapped", "remap"]


def remap(
    image: Tensor,
    source: Camera,
    target: Camera,
    rotation: Tensor | None = None,
    mode: str = "bilinear",
    mask: Tensor | None = None,
    fill: float = 0.0,
) -> Remapped:
    """The image of ``source`` as ``target`` would have taken it from the same place.

    Differentiable in the image and, but for ``"nearest"``, in the rotation and both cameras' intrinsics. For many
    images of one pair of cameras ``Remap`` is faster: it computes where to look once.

    Args:
        image: ``(*b, c, h, w)`` as taken by ``source``. Floating point, or of any type for ``"nearest"``.
        source: camera that took the image; batch dimensions of image, cameras and rotation broadcast.
        target: camera to imitate.
        rotation: ``(*b, 3, 3)``, target_from_source: what the source sees in direction d, the target sees in
            ``rotation @ d``. None: both look the same way.
        mode: ``"bilinear"`` reads four pixels around a point and aliases where the image shrinks. ``"area"`` is
            bilinear where it grows and the mean over all that a target pixel covers where it shrinks.
            ``"bicubic"`` is sharper and may overshoot. ``"nearest"`` makes up no values: for labels and masks.
            ``"depth"`` is for depth along the rays: linear in its inverse, so that planes stay planes, infinity
            is a depth, and unknown pixels (NaN, zero, negative) take no part.
        mask: ``(*b, h, w)``, pixels of the image that may be used (bool, or nonzero). Values are means over usable
            pixels; a target pixel is valid if it touches one.
        fill: value where not valid.

    Returns:
        Values ``(*b, c, h', w')`` of the image's dtype and ``valid`` ``(*b, h', w')``.

    Raises:
        ShapeError: image or mask are not of the source's size, or the rotation is no 3 x 3 matrix.
        ArgumentError: an unknown mode, integers in another mode than ``"nearest"``, a mask with ``"bicubic"``, or a
            fill that the image's type cannot hold.

    References:
        L. Williams, "Pyramidal parametrics", SIGGRAPH 1983, for the averaged images of ``"area"``.

    Examples:
        >>> import math, torch
        >>> from sphericalvision.cameras import FisheyeCamera, PinholeCamera
        >>> fisheye = FisheyeCamera.from_field_of_view((64, 64), math.radians(200))
        >>> pinhole = PinholeCamera([40.0, 40.0], [39.5, 29.5], (60, 80))
        >>> values, valid = remap(torch.ones(3, 64, 64), fisheye, pinhole)
        >>> values.shape, valid.all().item()
        (torch.Size([3, 60, 80]), True)
    """
    dtype = torch.promote_types(image.dtype, torch.float32)
    if not image.is_floating_point():
        dtype = torch.promote_types(source.dtype, target.dtype)
    tables = RemapTables(source, target, rotation, mode, mask, fill, dtype, image.device)
    answer: Remapped = tables(image)
    return answer


class Remap(nn.Module):
    """``remap`` between two fixed cameras, with its tables made once.

    The tables are computed in float64 and kept in ``dtype`` as buffers that are in no state dict; they move with
    ``.to`` and take no gradient. A call costs little more than one bare ``grid_sample``; with ``"area"``, about 16 of
    them for every target pixel that the map shrinks.

    Args:
        source: camera that takes the images.
        target: camera to imitate.
        rotation: ``(*b, 3, 3)``, target_from_source.
        mode: one of ``REMAP_MODES``, see ``remap``.
        mask: ``(*b, h, w)``, usable pixels of every image.
        fill: value where not valid.
        dtype: of the tables; torch's default if not given.
        device: of the tables; the source's if not given.

    Raises:
        ShapeError: see ``remap``.
        ArgumentError: see ``remap``.

    Examples:
        >>> import math
        >>> from sphericalvision.cameras import EquirectangularCamera, FisheyeCamera
        >>> fisheye = FisheyeCamera.from_field_of_view((64, 64), math.radians(180))
        >>> to_panorama = Remap(fisheye, EquirectangularCamera((32, 64)), mode="area")
        >>> to_panorama
        Remap((64, 64) to (32, 64), mode='area')
        >>> values, valid = to_panorama(torch.ones(5, 3, 64, 64))
        >>> values.shape, round(valid.double().mean().item(), 1)
        (torch.Size([5, 3, 32, 64]), 0.5)
    """

    def __init__(
        self,
        source: Camera,
        target: Camera,
        rotation: Tensor | None = None,
        mode: str = "bilinear",
        mask: Tensor | None = None,
        fill: float = 0.0,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        with torch.no_grad():
            tables = RemapTables(source, target, rotation, mode, mask, fill, torch.float64, "cpu")
        self.tables = tables.to(
            source.device if device is None else device, dtype or torch.get_default_dtype()
        )

    def forward(self, image: Tensor, mask: Tensor | None = None) -> Remapped:
        """The image ``(*b, c, h, w)`` in the target camera.

        Args:
            image: as taken by the source.
            mask: ``(*b, h, w)``, usable pixels of this image; with a mask of the module, those in both.

        Raises:
            ShapeError: image or mask are not of the source's size.
            ArgumentError: integers in another mode than ``"nearest"``.
        """
        answer: Remapped = self.tables(image, mask)
        return answer

    def __repr__(self) -> str:
        sizes = f"{self.tables.image_size} to {self.tables.target_size}"
        return f"{type(self).__name__}({sizes}, mode={self.tables.mode!r})"
