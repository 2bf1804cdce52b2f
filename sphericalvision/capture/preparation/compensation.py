# SPDX-License-Identifier: Apache-2.0
"""What cameras did to their images, taken out before depth is estimated: noise, exposure, vignetting."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.capture import PhotometricCalibration, calibrate_photometry

__all__ = ["compensated", "denoised", "evened", "evened_batch", "noise_of", "uneven_light", "without_noise"]

LEAST_LIGHT = 0.05
"""Share of the light: cameras that differ by less are taken to be alike."""
LEAST_NOISE = 0.01
"""Of the range [0, 1]: texture alone may look like less."""
WINDOW, REACH, CONTRAST = 7, 2.0, 4.0
"""Of the bilateral filter: pixels; deviation over places, pixels; and over colours, deviations of the noise."""
DARKEST, BRIGHTEST = 0.02, 0.98
"""Values beyond are clipped, or outside of the lens: no noise shows there."""
MOST_SAMPLES = 200_000
"""Values of an image that the noise is estimated from."""


def compensated(
    rig: CameraRig, images: Mapping[str, Float[Tensor, "*batch c _ _"]]
) -> dict[str, Float[Tensor, "*batch c _ _"]]:
    """Return images without noise, and without differences in exposure and vignetting."""
    return evened(rig, without_noise(rig, images))


def without_noise(
    rig: CameraRig, images: Mapping[str, Float[Tensor, "*batch c _ _"]]
) -> dict[str, Float[Tensor, "*batch c _ _"]]:
    """Return the images of a rig, each ``denoised`` by what its mask leaves of it."""
    return {name: denoised(image, rig.masks.get(name)) for name, image in images.items()}


def denoised(
    image: Float[Tensor, "*batch c h w"], usable: Bool[Tensor, "h w"] | None = None
) -> Float[Tensor, "*batch c h w"]:
    """Return an image with its noise smoothed by a bilateral filter, or as it is where there is little.

    Args:
        image: in [0, 1], of 1 or 3 channels.
        usable: False where the image shows something else; that has no influence on the rest.

    References:
        Tomasi, Manduchi (1998), "Bilateral filtering for gray and color images".

    Examples:
        >>> clean = torch.full((3, 64, 64), 0.5)
        >>> noisy = clean + 0.03 * torch.randn(3, 64, 64, generator=torch.Generator().manual_seed(0))
        >>> bool((denoised(noisy) - clean).std() < 0.5 * (noisy - clean).std()), denoised(clean) is clean
        (True, True)
    """
    frames = image.detach().reshape(-1, *image.shape[-3:])
    inside = None if usable is None else _inside(usable)
    found = [_denoised(frame, inside) for frame in frames]
    if all(smooth is None for smooth in found):
        return image
    parts = [frame if smooth is None else smooth for frame, smooth in zip(frames, found, strict=True)]
    return torch.stack(parts).view_as(image)


def _denoised(image: Tensor, inside: np.ndarray | None) -> Tensor | None:
    noise = _noise(image, inside)
    if noise < LEAST_NOISE:
        return None
    pixels = np.ascontiguousarray(image.movedim(0, -1).float().cpu().numpy())
    smooth = np.atleast_3d(cv2.bilateralFilter(pixels, WINDOW, CONTRAST * noise, REACH))
    if inside is not None:
        smooth = np.where(inside[..., None], smooth, pixels)
    return torch.from_numpy(smooth).movedim(-1, 0).to(image)


def noise_of(image: Float[Tensor, "c h w"], usable: Bool[Tensor, "h w"] | None = None) -> float:
    """Return the standard deviation of an image's noise, as far as one can tell it from texture.

    It is what second differences leave that answer neither to straight edges nor to shading; the median, as texture is
    not everywhere.

    Args:
        image: in [0, 1].
        usable: as of ``denoised``.

    References:
        Immerkær (1996), "Fast noise variance estimation".

    Examples:
        >>> shade = torch.linspace(0.3, 0.7, 64).expand(3, 64, 64)
        >>> noisy = shade + 0.03 * torch.randn(3, 64, 64, generator=torch.Generator().manual_seed(0))
        >>> round(noise_of(shade), 3), round(noise_of(noisy), 2)
        (0.0, 0.03)
    """
    return _noise(image.detach(), None if usable is None else _inside(usable))


def _inside(usable: Tensor) -> np.ndarray:
    """Pixels of which the whole window is usable: True where the filter sees nothing else."""
    kernel = np.ones((WINDOW, WINDOW), np.uint8)
    return cv2.erode(usable.cpu().numpy().astype(np.uint8), kernel).astype(bool)


def _noise(image: Tensor, inside: np.ndarray | None) -> float:
    """Of some rows of an image: of a second difference down of a second difference across."""
    height, width = image.shape[-2:]
    if min(height, width) < 3:
        return 0.0
    step = max(1, round(image.numel() / MOST_SAMPLES))
    above, middle, below = (image[:, start : height - 2 + start : step].float() for start in range(3))
    down = above - 2 * middle + below
    left = down[..., :-2] - 2 * down[..., 1:-1] + down[..., 2:]
    values = middle[..., 1:-1]
    shown = (values > DARKEST) & (values < BRIGHTEST)
    if inside is not None:
        shown &= torch.from_numpy(inside[1 : height - 1 : step, 1:-1]).to(shown.device)
    if not shown.any():
        return 0.0
    return float(left[shown].abs().median()) / (
        6 * 0.6745
    )  # by the differences' norm; of a Gaussian's median


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
