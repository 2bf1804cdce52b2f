# SPDX-License-Identifier: Apache-2.0
"""What cameras did to their images, taken out before depth is estimated: differences in exposure and vignetting."""

from __future__ import annotations

from collections.abc import Mapping

from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras import CameraRig, PhotometricCalibration, calibrate_photometry

__all__ = ["evened", "evened_batch", "uneven_light"]

LEAST_LIGHT = 0.05
"""Share of the light: cameras that differ by less are taken to be alike."""


def evened_batch(
    rig: CameraRig, photographs: Mapping[str, Tensor], lights: list[PhotometricCalibration | None]
) -> dict[str, Tensor]:
    """Images ``(*b, 3, h, w)`` without what is to be taken out of each frame."""
    flat = {name: image.reshape(-1, *image.shape[-3:]).clone() for name, image in photographs.items()}
    for frame, light in enumerate(lights):
        if light is not None:
            even = light.corrected(rig, {name: images[frame] for name, images in flat.items()})
            for name, image in even.items():
                flat[name][frame] = image
    return {name: flat[name].view_as(image) for name, image in photographs.items()}


def uneven_light(
    rig: CameraRig, images: Mapping[str, Float[Tensor, "*batch c _ _"]]
) -> PhotometricCalibration | None:
    """Return how exposure and vignetting of a rig's cameras differ, None where the difference is negligible."""
    found = calibrate_photometry(rig, images)
    return found if found.strength > LEAST_LIGHT else None


def evened(
    rig: CameraRig, images: Mapping[str, Float[Tensor, "*batch c _ _"]]
) -> dict[str, Float[Tensor, "*batch c _ _"]]:
    """Return images without these differences.

    Examples:
        >>> import torch
        >>> from sphericalvision.cameras import ring_rig
        >>> images = {"cam1": torch.full((3, 32, 32), 0.5), "cam2": torch.full((3, 32, 32), 0.49)}
        >>> evened(ring_rig(2, image_size=(32, 32)), images)["cam2"] is images["cam2"]
        True
    """
    light = uneven_light(rig, images)
    return dict(images) if light is None else light.corrected(rig, images)
