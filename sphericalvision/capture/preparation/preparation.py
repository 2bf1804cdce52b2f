# SPDX-License-Identifier: Apache-2.0
"""``Preparation``: how a capture is made ready before depth is estimated, as one value.

What cameras did to their images is taken out: noise, exposure, vignetting.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.preparation.photometry import Photometer, PhotometricCalibration, pixel_angles
from sphericalvision.core import ArgumentError

__all__ = [
    "AS_IT_IS",
    "Compensation",
    "Compensator",
    "Preparation",
    "compensated",
    "denoised",
    "noise_of",
]

LEAST_LIGHT = 0.05
"""Share of the light: cameras that differ by less are taken to be alike."""
SURE = 2.0
"""Standard deviations by which the difference exceeds that for sure."""
LEAST_NOISE = 0.01
"""Of the range [0, 1]: texture alone may look like less."""
WINDOW, REACH, CONTRAST = 7, 2.0, 4.0
"""Of the bilateral filter: pixels; deviation over places, pixels; and over colours, deviations of the noise."""
BRIGHT_SHARE, BRIGHT, DARK, BLACK = 0.95, 0.7, 0.2, 0.002
"""The share of all values that bright ones are above, what they usually are, below what a frame is dark, and below what
there is nothing to be seen."""
DARKEST, BRIGHTEST = 0.02, 0.98
"""Values beyond are clipped, or outside of the lens: no noise shows there."""
MOST_SAMPLES = 200_000
"""Values of an image that the noise is estimated from."""


@dataclass(frozen=True)
class Preparation:
    """How a capture is made ready before depth is estimated.

    Attributes:
        photometric: whether noise of more than 1 % is smoothed, and differences in exposure and vignetting between the
            cameras are compensated if they exceed 5 %. All are estimated from each frame (``calibrate_photometry``).
        align: whether cameras that a few frames show to be turned are turned back (``align_rig``).

    Raises:
        ArgumentError: a value is not True or False.

    Examples:
        >>> Preparation(photometric=False)
        Preparation(photometric=False, align=True)
    """

    photometric: bool = True
    align: bool = True

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not isinstance(value, bool):
                raise ArgumentError(f"{field.name}: expected true or false, got {value!r}")

    def judges(self, rig: CameraRig) -> bool:
        """Return whether a few frames are to say if cameras are turned; one camera has nothing to be compared with."""
        return self.align and len(rig) > 1

    @property
    def of_images(self) -> Callable[[CameraRig, Mapping[str, Tensor]], dict[str, Tensor]] | None:
        """The function of a rig and the images of a frame that makes these ready; None where nothing is done."""
        return compensated if self.photometric else None

    def images(
        self, rig: CameraRig, images: Mapping[str, Float[Tensor, "*batch c _ _"]]
    ) -> dict[str, Float[Tensor, "*batch c _ _"]]:
        """Return the images of a frame, camera name -> ``(*b, c, h, w)`` in [0, 1], made ready."""
        return dict(images) if self.of_images is None else self.of_images(rig, images)


AS_IT_IS = Preparation(photometric=False, align=False)


class Compensation(NamedTuple):
    """What was taken out of the images of one frame.

    Attributes:
        noise: camera name -> standard deviation of the noise that was smoothed, of the range [0, 1]; 0 where none was.
        light: how exposure and vignetting differed; None where the difference was negligible.
        gain: factor on all images, where all were dark; else 1.
    """

    noise: Mapping[str, float]
    light: PhotometricCalibration | None = None
    gain: float = 1.0

    def described(self) -> list[str]:
        """Return a sentence for each of the three; none where nothing was done."""
        sentences = []
        if self.gain != 1:
            sentences.append(f"brightens dark images {self.gain:.1f} times")
        if any(self.noise.values()):
            strength = ", ".join(
                f"{100 * amount:.1f} % of {name}" for name, amount in self.noise.items() if amount
            )
            sentences.append(f"smooths noise: {strength}")
        if self.light is not None:
            exposure, falloff = self.light.exposure.mean(1).exp(), 1 - (-self.light.falloff.sum(1)).exp()
            sentences.append(
                f"compensates exposures of {exposure.min():.2f} to {exposure.max():.2f} of the mean and lenses that "
                f"lose up to {100 * falloff.max().clamp(min=0):.0f} % of the light at the edge"
            )
        return sentences


class Compensator:
    """Takes noise, exposure and vignetting out of the images of a rig; what follows from the rig is computed once.

    Args:
        rig: unbatched.
    """

    def __init__(self, rig: CameraRig) -> None:
        self.rig = rig
        self._usable = {name: _inside(mask) for name, mask in rig.masks.items()}

    @cached_property
    def _photometer(self) -> Photometer:
        return Photometer(self.rig)

    @cached_property
    def _angles(self) -> dict[str, Tensor]:
        return pixel_angles(self.rig)

    def brightened(
        self, images: Mapping[str, Float[Tensor, "*batch c _ _"]]
    ) -> tuple[dict[str, Float[Tensor, "*batch c _ _"]], list[float]]:
        """Return images as bright as is usual, where those of all cameras are dark, and the factor of each frame.

        So are scenes at night, and pictures of 10 or 12 bits that are stored in 16.
        """
        flat = [image.reshape(-1, *image.shape[-3:]) for image in images.values()]
        gains = []
        for frame in zip(*flat, strict=True):
            values = torch.cat([_spread(image) for image in frame])
            # Not by `quantile`, which sorts: that took longer than anything else that is done to images.
            bright = values.kthvalue(math.ceil(BRIGHT_SHARE * len(values))).values.item()
            gains.append(BRIGHT / bright if BLACK < bright < DARK else 1.0)
        if all(gain == 1 for gain in gains):
            return dict(images), gains
        factors = flat[0].new_tensor(gains).view(-1, 1, 1, 1)
        bright_images = {
            name: (image * factors).clamp(max=1).view_as(images[name])
            for name, image in zip(images, flat, strict=True)
        }
        return bright_images, gains

    def smoothed(
        self, images: Mapping[str, Float[Tensor, "*batch c _ _"]]
    ) -> tuple[dict[str, Float[Tensor, "*batch c _ _"]], list[dict[str, float]]]:
        """Return images without noise, and frame by frame how much there was in that of each camera."""
        smooth, noise = {}, {}
        for name, image in images.items():
            smooth[name], noise[name] = _smoothed(image, self._usable.get(name))
        return smooth, [dict(zip(noise, frame, strict=True)) for frame in zip(*noise.values(), strict=True)]

    def light(self, images: Mapping[str, Float[Tensor, "*batch c _ _"]]) -> PhotometricCalibration | None:
        """Return how exposure and vignetting of the cameras differ, None where the difference is negligible."""
        calibration = self._photometer(images)
        return calibration if calibration.strength - SURE * calibration.spread > LEAST_LIGHT else None

    def evened(
        self, images: Mapping[str, Float[Tensor, "*batch c _ _"]], light: PhotometricCalibration | None
    ) -> dict[str, Float[Tensor, "*batch c _ _"]]:
        """Return images without these differences."""
        return dict(images) if light is None else light.divided_out(images, self._angles)


def compensated(
    rig: CameraRig, images: Mapping[str, Float[Tensor, "*batch c _ _"]]
) -> dict[str, Float[Tensor, "*batch c _ _"]]:
    """Return images without noise, and without differences in exposure and vignetting; a batch counts as one frame.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> images = {"cam1": torch.full((3, 32, 32), 0.5), "cam2": torch.full((3, 32, 32), 0.49)}
        >>> compensated(ring_rig(2, image_size=(32, 32)), images)["cam2"] is images["cam2"]
        True
    """
    compensator = Compensator(rig)
    smooth, _ = compensator.smoothed(compensator.brightened(images)[0])
    return compensator.evened(smooth, compensator.light(smooth))


def _spread(image: Tensor) -> Tensor:
    """Some of an image's values, from all over it."""
    step = max(1, round((image.numel() / MOST_SAMPLES) ** 0.5))
    return image[:, ::step, ::step].detach().float().flatten()


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
    return _smoothed(image, None if usable is None else _inside(usable))[0]


def _smoothed(image: Tensor, inside: np.ndarray | None) -> tuple[Tensor, list[float]]:
    """An image or a batch of them, smoothed where it has to be, and the noise of each frame that was."""
    frames = image.detach().reshape(-1, *image.shape[-3:])
    noise = [found if (found := _noise(frame, inside)) >= LEAST_NOISE else 0.0 for frame in frames]
    if not any(noise):
        return image, noise
    parts = []
    for frame, amount in zip(frames, noise, strict=True):
        if amount:
            pixels = np.ascontiguousarray(frame.movedim(0, -1).float().cpu().numpy())
            smooth = np.atleast_3d(cv2.bilateralFilter(pixels, WINDOW, CONTRAST * amount, REACH))
            if inside is not None:
                smooth = np.where(inside[..., None], smooth, pixels)
            frame = torch.from_numpy(smooth).movedim(-1, 0).to(image)
        parts.append(frame)
    return torch.stack(parts).view_as(image), noise


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
    second = down[..., :-2] - 2 * down[..., 1:-1] + down[..., 2:]
    values = middle[..., 1:-1]
    shown = (values > DARKEST) & (values < BRIGHTEST)
    if inside is not None:
        shown &= torch.from_numpy(inside[1 : height - 1 : step, 1:-1]).to(shown.device)
    if not shown.any():
        return 0.0
    return float(second[shown].abs().median()) / (
        6 * 0.6745
    )  # by the differences' norm; of a Gaussian's median
