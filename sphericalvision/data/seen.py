# SPDX-License-Identifier: Apache-2.0
"""Which pixels of a rig's cameras show something: those in the field of view that no mask takes away."""

from __future__ import annotations

from jaxtyping import Bool
from torch import Tensor

from sphericalvision.cameras import CameraRig

__all__ = ["pixels_seen"]


def pixels_seen(rig: CameraRig) -> dict[str, Bool[Tensor, "_ _"]]:
    """Tell for each camera which pixels were seen.

    Args:
        rig: unbatched.

    Returns:
        Camera name -> bool ``(h, w)``, True where the pixel's centre lies in the field of view and the mask, if there
        is one, leaves it.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> seen = pixels_seen(ring_rig(2, image_size=(32, 32)))
        >>> seen["cam1"].shape, bool(seen["cam1"][16, 16]), bool(seen["cam1"][0, 0])
        (torch.Size([32, 32]), True, False)
    """
    seen = {}
    for name, camera in rig.cameras.items():
        valid = camera.unproject(camera.pixel_grid()).valid
        seen[name] = valid & rig.masks[name].bool() if name in rig.masks else valid
    return seen
