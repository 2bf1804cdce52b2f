# SPDX-License-Identifier: Apache-2.0
"""Images averaged to what a comparison of cameras needs: estimates cost the same whatever the resolution."""

from __future__ import annotations

from collections.abc import Mapping

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.remapping.lookup import pixels_a_radian

__all__ = ["averaged", "reduced_rig"]


def reduced_rig(rig: CameraRig, pixel: float) -> CameraRig:
    """Return the rig of images whose pixels are not finer than ``pixel``, in radians at the optical axis.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> reduced_rig(ring_rig(3, image_size=(768, 800)), 0.02).cameras["cam1"].image_size
        (192, 200)
    """
    sizes = {}
    for name, camera in rig.cameras.items():
        shrink = max(1, int(pixel * pixels_a_radian(camera)))
        sizes[name] = tuple(max(1, round(length / shrink)) for length in camera.image_size)
    return rig.resized(sizes)


def averaged(
    rig: CameraRig, images: Mapping[str, Float[Tensor, "*batch c _ _"]]
) -> dict[str, Float[Tensor, "*batch c _ _"]]:
    """Return whole images averaged to the sizes of a rig's cameras; those that have them are handed on."""
    small = {}
    for name, camera in rig.cameras.items():
        image = images[name]
        if tuple(image.shape[-2:]) != camera.image_size:
            flat = F.interpolate(image.reshape(-1, *image.shape[-3:]), camera.image_size, mode="area")
            image = flat.reshape(*image.shape[:-2], *camera.image_size)
        small[name] = image
    return small
