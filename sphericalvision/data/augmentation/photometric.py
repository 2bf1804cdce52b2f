# SPDX-License-Identifier: Apache-2.0
"""Photometric augmentation by kornia, repeatable by a seed."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pad

from sphericalvision.data.collate import Sample
from sphericalvision.shapes import check_shapes
from sphericalvision.sphere.intake import signed, unsigned

SEEN = {"images": "seen", "fisheye": "fisheye_seen"}
"""Entries with colours, and the entries with their masks of seen pixels."""


class PhotometricAugmentation(nn.Module):
    """Change brightness, contrast, colour and noise of a sample's images as different sensors would.

    The defaults follow the published training for real images: brightness by up to 0.1 (25 of 255),
    contrast by up to a fifth, noise of up to a hundredth, for each camera on its own. Works before
    ``ToSphere`` (images by camera name), after it (one tensor) and on ``fisheye`` images ``(n, 3, h, w)`` in
    [-1, 1]. In tensors, what was not seen (False in ``seen`` or ``fisheye_seen``) stays as it was; without such an
    entry everything was seen.

    Args:
        brightness: largest amount added or taken away, of the range [0, 1].
        contrast: largest change of the factor 1 on grey levels.
        noise: standard deviation of Gaussian noise, of the range [0, 1].
        generator: source of randomness; torch's global one when not given.

    References:
        Komatsu et al., IROS 2020, augmentation for real images.

    Examples:
        >>> augment = PhotometricAugmentation(generator=torch.Generator().manual_seed(0))
        >>> images = torch.rand(4, 3, 8, 8)
        >>> torch.equal(augment.apply_to(images, seed=1), augment.apply_to(images, seed=1))
        True
        >>> torch.equal(augment.apply_to(images, seed=1), augment.apply_to(images, seed=2))
        False
    """

    def __init__(
        self,
        brightness: float = 0.1,
        contrast: float = 0.2,
        noise: float = 0.01,
        generator: torch.Generator | None = None,
    ) -> None:
        from kornia.augmentation import ColorJiggle, RandomGaussianNoise  # a second to import

        super().__init__()
        self.generator = generator
        self.color = ColorJiggle(brightness, contrast)
        self.noise = RandomGaussianNoise(mean=0.0, std=noise, p=0.5)

    @check_shapes
    def apply_to(self, images: Float[Tensor, "n 3 h w"], seed: int) -> Float[Tensor, "n 3 h w"]:
        """Augment images ``(n, 3, h, w)`` in [0, 1]; the same seed does the same again."""
        devices = [images.device] if images.device.type == "cuda" else []
        with torch.random.fork_rng(devices):  # kornia draws from the global generator only
            torch.manual_seed(seed)
            return self.noise(self.color(images)).clamp(0, 1)

    def forward(self, sample: Sample) -> Sample:
        """The sample with augmented ``images`` and ``fisheye``, whichever it has: both in the same way."""
        seed = int(torch.randint(2**62, (), generator=self.generator))
        entries = (key for key in SEEN if key in sample)
        return sample | {key: self._changed(sample[key], sample.get(SEEN[key]), seed) for key in entries}

    def _changed(
        self, images: Tensor | Mapping[str, Tensor], seen: Tensor | None, seed: int
    ) -> Tensor | dict[str, Tensor]:
        if isinstance(images, Tensor):
            flat = images if images.ndim == 4 else images[:, :, None]
            colored = signed(self.apply_to(unsigned(flat), seed)).view(images.shape)
            return colored if seen is None else torch.where(seen[:, None], colored, images)
        height, width = (max(image.shape[axis] for image in images.values()) for axis in (-2, -1))
        padded = [
            pad(image, (0, width - image.shape[-1], 0, height - image.shape[-2])) for image in images.values()
        ]
        colored = self.apply_to(torch.stack(padded), seed)  # pixel by pixel, so the padding changes nothing
        return {
            name: changed[:, : image.shape[-2], : image.shape[-1]]
            for (name, image), changed in zip(images.items(), colored, strict=True)
        }
