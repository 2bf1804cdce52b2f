# SPDX-License-Identifier: Apache-2.0
"""``Preparation``: how a capture is preprocessed before depth is estimated, as one value.

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
import torch.nn.functional as F
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.remapping.area import as_floats
from sphericalvision.capture.preparation.photometry import (
    LightEstimate,
    Photometer,
    PhotometricCalibration,
    median_of_known,
)
from sphericalvision.core import ArgumentError
from sphericalvision.kernels import Operator, may_hold

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
WHOLE = 0.999
"""Share of the pixels of a mean that a mask leaves, if it leaves all."""
MOST_SAMPLES = 50_000
"""Values of an image that its noise and brightness are estimated from: to 1 % of either."""


class _Usable(NamedTuple):
    """Where the window of the filter sees nothing but what a mask leaves; None without a mask."""

    pixels: Tensor | None = None
    """Of the images ``(h, w)``."""
    means: Tensor | None = None
    """Of the averaged ones."""


@dataclass(frozen=True)
class Preparation:
    """How a capture is preprocessed before depth is estimated.

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
        """Return the images of a frame, camera name -> ``(*b, c, h, w)`` in [0, 1], preprocessed."""
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


class Correction(NamedTuple):
    """What was taken out of the images of one frame, as tensors on the device of the images.

    Attributes:
        noise: ``(n,)`` by camera; 0 where none was smoothed.
        gain: factor on all images.
        light: how exposure and vignetting differ; None for one camera. It was taken out if it ``differs``.
    """

    noise: Float[Tensor, " n"]
    gain: Float[Tensor, ""]
    light: LightEstimate | None

    def compensation(self, rig: CameraRig) -> Compensation:
        """Return the same with plain numbers, for which a device is waited for."""
        light = None
        if self.light is not None and differs(self.light):
            light = self.light.calibration()
        return Compensation(dict(zip(rig.names, self.noise.tolist(), strict=True)), light, float(self.gain))


class Compensator:
    """Takes noise, exposure and vignetting out of the images of a rig; what follows from the rig is computed once.

    What it finds are tensors, and what they decide is chosen by ``where``: no number goes to the host.

    Args:
        rig: unbatched.
        averaged: makes the images of the cameras smaller, by their names; without it they stay as large. Noise is
            smoothed in what it returns: fewer values, of less noise.
    """

    def __init__(
        self, rig: CameraRig, averaged: Callable[[Mapping[str, Tensor]], dict[str, Tensor]] = dict
    ) -> None:
        self.rig, self._averaged = rig, averaged
        masks = {
            name: torch.ones(1, *camera.image_size, device=rig.world_from_camera.device)
            for name, camera in rig.cameras.items()
        }
        masks |= {name: mask[None].float() for name, mask in rig.masks.items()}
        means = averaged(masks) if rig.masks else {}
        self._usable = dict.fromkeys(rig.names, _Usable())
        for name, mask in rig.masks.items():
            self._usable[name] = _Usable(_inside(mask), _inside(means[name][0] > WHOLE))

    @cached_property
    def light(self) -> Callable[[Mapping[str, Tensor]], LightEstimate]:
        """Tells of images how exposure and vignetting of the cameras differ; a batch counts as one frame."""
        return Photometer(self.rig).estimate

    def brightened(
        self, images: Mapping[str, Shaped[Tensor, "b c _ _"]]
    ) -> tuple[dict[str, Shaped[Tensor, "b c _ _"]], Float[Tensor, " b"]]:
        """Return images as bright as is usual, where those of all cameras are dark, and the factor of each frame.

        So are scenes at night, and pictures of 10 or 12 bits that are stored in 16.
        """
        values = torch.cat([_spread(image) for image in images.values()], 1)
        # A CPU selects faster than it sorts; on a CUDA device selecting took a sixth of a frame, and sorting is free.
        rank = math.ceil(BRIGHT_SHARE * values.shape[1])
        ordered = values.sort().values[:, rank - 1] if values.is_cuda else values.kthvalue(rank).values
        bright = ordered.double()
        dark = (bright > BLACK) & (bright < DARK)
        gains = (BRIGHT / bright).where(dark, 1.0)
        if not may_hold(dark):
            return dict(images), gains
        factors = gains.to(values.dtype).view(-1, 1, 1, 1)
        chosen = dark.view(-1, 1, 1, 1)
        floats = {name: as_floats(image) for name, image in images.items()}
        return {
            name: (image * factors).clamp(max=1).where(chosen, image) for name, image in floats.items()
        }, gains

    def smoothed(
        self, images: Mapping[str, Shaped[Tensor, "b c _ _"]]
    ) -> tuple[dict[str, Float[Tensor, "b c _ _"]], Float[Tensor, "b n"]]:
        """Return averaged images without noise, and how much there was in those of each camera."""
        means = self._averaged(images)
        usable = [self._usable[name] for name in images]
        smooth, noise = _smooth_cameras(list(images.values()), [means[name] for name in images], usable)
        return dict(zip(images, smooth, strict=True)), noise


def differs(light: LightEstimate) -> Bool[Tensor, ""]:
    """Return whether a difference between cameras is large enough, and sure enough, to be taken out."""
    return light.strength - SURE * light.spread > LEAST_LIGHT


def compensated(
    rig: CameraRig, images: Mapping[str, Float[Tensor, "*batch c _ _"]]
) -> dict[str, Float[Tensor, "*batch c _ _"]]:
    """Return images without noise, and without differences in exposure and vignetting; a batch counts as one frame.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> images = {"cam1": torch.full((3, 32, 32), 0.5), "cam2": torch.full((3, 32, 32), 0.49)}
        >>> torch.equal(compensated(ring_rig(2, image_size=(32, 32)), images)["cam2"], images["cam2"])
        True
    """
    compensator = Compensator(rig)
    flat = {name: image.reshape(-1, *image.shape[-3:]) for name, image in images.items()}
    smooth, _ = compensator.smoothed(compensator.brightened(flat)[0])
    light = compensator.light(smooth)
    if may_hold(differs(light)):
        even = light.calibration().corrected(rig, smooth)
        smooth = {name: image.where(differs(light), smooth[name]) for name, image in even.items()}
    return {name: image.view_as(images[name]) for name, image in smooth.items()}


def _spread(image: Tensor) -> Tensor:
    """Some values of each frame ``(b, values)``, from all over the image."""
    step = max(1, round((image[0].numel() / MOST_SAMPLES) ** 0.5))
    return as_floats(image[..., ::step, ::step].detach()).float().flatten(1)


def _smoothed(image: Tensor, means: Tensor, usable: _Usable) -> tuple[Tensor, Tensor]:
    """Means of frames ``(b, c, h, w)``, each smoothed by a bilateral filter where the frame is noisy, and the noise.

    The noise is that of the frame ``(b,)``; 0 where it is little. In its means there is less, of fewer values.

    References:
        Tomasi, Manduchi (1998), "Bilateral filtering for gray and color images".
    """
    noise = _noise(image.detach(), usable.pixels)
    noise = noise.where(noise >= LEAST_NOISE, 0.0)
    if not may_hold(noise > 0):
        return means, noise
    shrink = image.shape[-1] / means.shape[-1]
    chosen = (noise > 0).view(-1, 1, 1, 1)
    if usable.means is not None:
        chosen = chosen & usable.means
    fixed = means.detach()
    change = _filtered(fixed, CONTRAST * noise / shrink) - fixed
    return means + change.where(chosen, 0.0), noise


def _smooth_each(
    images: list[Tensor], means: list[Tensor], usable: list[_Usable]
) -> tuple[list[Tensor], Tensor]:
    smooth, noise = zip(*map(_smoothed, images, means, usable), strict=True)
    return list(smooth), torch.stack(noise, 1)


def _smooth_together(
    images: list[Tensor], means: list[Tensor], usable: list[_Usable]
) -> tuple[list[Tensor], Tensor]:
    """Smooth the images of cameras that are alike in one batch: a quarter of the operations, if there are four."""
    alike = all(image.shape == images[0].shape for image in images)
    alike = alike and all(image.shape == means[0].shape for image in means)
    if not alike or any(mask.pixels is not None for mask in usable):
        return NotImplemented
    smooth, noise = _smoothed(torch.cat(images), torch.cat(means), usable[0])
    return list(smooth.split(len(images[0]))), noise.view(len(images), -1).mT


_smooth_cameras = Operator(_smooth_each, fused=_smooth_together)


def _filtered_by_opencv(image: Tensor, deviation: Tensor) -> Tensor:
    """``bilateral`` of the frames whose deviation is above 0; on a CPU ten times as fast."""
    frames = []
    for frame, amount in zip(image, deviation.tolist(), strict=True):
        if amount:
            pixels = np.ascontiguousarray(frame.movedim(0, -1).float().numpy())
            smooth = np.atleast_3d(cv2.bilateralFilter(pixels, WINDOW, amount, REACH))
            frame = torch.from_numpy(smooth).movedim(-1, 0).to(image)
        frames.append(frame)
    return torch.stack(frames)


def bilateral(image: Float[Tensor, "b c h w"], deviation: Float[Tensor, " b"]) -> Float[Tensor, "b c h w"]:
    """Return weighted means of the pixels around each, those of other colours weighing less; as OpenCV defines it.

    Args:
        image: ``(b, c, h, w)``.
        deviation: ``(b,)``, of the weight over differences of colours, which are summed over channels.

    Examples:
        >>> step = torch.tensor([0.0, 1.0]).repeat_interleave(8).expand(1, 1, 16, 16)
        >>> torch.equal(bilateral(step, torch.tensor([0.05])), step)  # edges stay
        True
    """
    radius = WINDOW // 2
    height, width = image.shape[-2:]
    mode = "reflect" if min(height, width) > radius else "replicate"
    steepness = (-0.5 / deviation.square()).where(deviation > 0, 0.0).to(image.dtype)
    return _bilateral(image, steepness, mode)


def _bilateral_in_triton(image: Tensor, steepness: Tensor, mode: str) -> Tensor:
    if image.dtype != torch.float32 or mode != "reflect":
        return NotImplemented
    from sphericalvision.capture.preparation import bilateral_triton  # Triton is not everywhere

    return bilateral_triton.bilateral_kernel(image, steepness, WINDOW // 2, REACH)


def _bilateral_by_shifts(image: Tensor, steepness: Tensor, mode: str) -> Tensor:
    radius = WINDOW // 2
    height, width = image.shape[-2:]
    padded, steepness = F.pad(image, (radius,) * 4, mode=mode), steepness.view(-1, 1, 1, 1)
    weights = torch.zeros_like(image[:, :1])
    total = torch.zeros_like(image)
    for down in range(-radius, radius + 1):
        for across in range(-radius, radius + 1):
            squared = down**2 + across**2
            if squared > radius**2:
                continue
            moved = padded[..., radius + down :, radius + across :][..., :height, :width]
            difference = (moved - image).abs_().sum(1, keepdim=True)
            weight = difference.square_().mul_(steepness).exp_()
            closeness = math.exp(-0.5 * squared / REACH**2)
            weights.add_(weight, alpha=closeness)
            total.addcmul_(weight, moved, value=closeness)
    return total.div_(weights)


_bilateral = Operator(_bilateral_by_shifts, triton=_bilateral_in_triton)
_filtered = Operator(bilateral, cpu=_filtered_by_opencv)


def _inside(usable: Tensor) -> Tensor:
    """Pixels of which the whole window is usable: True where the filter sees nothing else."""
    kernel = np.ones((WINDOW, WINDOW), np.uint8)
    eroded = cv2.erode(usable.cpu().numpy().astype(np.uint8), kernel)
    return torch.from_numpy(eroded.astype(bool)).to(usable.device)


def _noise(image: Tensor, inside: Tensor | None) -> Tensor:
    """Standard deviation of the noise of each frame ``(b, c, h, w)``, as far as one can tell it from texture.

    It is what second differences leave that answer neither to straight edges nor to shading; the median, as texture is
    not everywhere. Of large images some rows count.

    References:
        Immerkær (1996), "Fast noise variance estimation".
    """
    height, width = image.shape[-2:]
    if min(height, width) < 3:
        return image.new_zeros(len(image), dtype=torch.float64)
    step = max(1, round(image[0].numel() / MOST_SAMPLES))
    lines = (image[..., start : height - 2 + start : step, :] for start in range(3))
    above, middle, below = (as_floats(line).float() for line in lines)
    down = above - 2 * middle + below
    second = down[..., :-2] - 2 * down[..., 1:-1] + down[..., 2:]
    values = middle[..., 1:-1]
    exposed = (values > DARKEST) & (values < BRIGHTEST)
    if inside is not None:
        exposed &= inside[1 : height - 1 : step, 1:-1]
    typical = median_of_known(second.abs().where(exposed, math.nan).flatten(1))
    return typical.double() / (6 * 0.6745)  # by the differences' norm; of a Gaussian's median
