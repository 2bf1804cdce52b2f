# SPDX-License-Identifier: Apache-2.0
"""Transforms of samples: onto the icosphere, and the geometric augmentations of training."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError, ArgumentTypeError
from sphericalvision.data.collate import Sample
from sphericalvision.data.omnistereo.ground_truth import check_panorama_size
from sphericalvision.geometry.directions import holds
from sphericalvision.icosphere import Icosphere
from sphericalvision.shapes import check_shapes
from sphericalvision.sphere import Equirectangular
from sphericalvision.sphere.intake import Intake

FARTHEST = 3.0
"""On average from 0, of values in [-1, 1]: no noise brings them there, and floats up to 255 are farther."""


class Compose:
    """Several transforms, one after the other.

    Examples:
        >>> both = Compose(lambda sample: sample + ["first"], lambda sample: sample + ["second"])
        >>> both([])
        ['first', 'second']
    """

    def __init__(self, *transforms: Callable[[Any], Any]) -> None:
        for transform in transforms:
            if not callable(transform):
                raise ArgumentTypeError(
                    f"transforms: expected functions of a sample, one after the other, got {type(transform).__name__}; "
                    "Compose(first, second) takes no list"
                )
        self.transforms = transforms

    def __call__(self, sample: Any) -> Any:
        for transform in self.transforms:
            sample = transform(sample)
        return sample

    def __repr__(self) -> str:
        return f"Compose({', '.join(map(repr, self.transforms))})"


class ToSphere:
    """Resample the images and the ground-truth panorama of a sample onto the icosphere.

    Images are looked up bilinearly at the vertices, each camera turned into world orientation (its position
    plays no part) and scaled to [-1, 1]; what lies outside a camera's field of view, image or mask is 0.
    Ground truth is the nearest panorama pixel to each vertex, not interpolated, as in the paper's
    evaluation; vertices beyond the latitudes of the urban sets are not valid.

    The table of pixel positions is cached as long as samples have the same rig object.

    Args:
        level: of the icosphere that carries the images.
        depth_level: of the icosphere that carries inverse depth and validity; two below ``level`` when not
            given.
        antialias: average the image over the area between vertices first, for images much finer than the
            icosphere; slower. The paper does without.

    Returns:
        The sample with ``images`` ``(n, 3, V)`` in the order of the rig's cameras and ``seen`` ``(n, V)``,
        ``inverse_depth`` ``(V_depth,)`` in 1/m (0 where not valid), ``valid`` ``(V_depth,)``; the other entries as
        they were.

    References:
        Komatsu et al., 360 Depth Estimation from Multiple Fisheye Images with Origami Crown Representation of
        Icosahedron, IROS 2020, section III.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.scenes import make_scene, render_rig
        >>> rig = ring_rig(3, image_size=(24, 24))
        >>> ToSphere(3).images(render_rig(make_scene("room"), rig), rig).shape
        torch.Size([3, 3, 642])
    """

    def __init__(self, level: int, depth_level: int | None = None, antialias: bool = False) -> None:
        self.level = level
        self.depth_level = level - 2 if depth_level is None else depth_level
        if self.depth_level < 0:
            raise ArgumentError(
                f"level: expected at least 2, so that depth_level = level - 2 exists, got {level}"
            )
        self.antialias = antialias
        self._grid = Icosphere(level)
        self._depth_directions = Icosphere(self.depth_level, torch.float64).vertices
        self._panorama: Equirectangular | None = None
        self._intake: Intake | None = None

    def __call__(self, sample: Sample) -> Sample:
        inverse_depth, valid = self.ground_truth(sample["inverse_depth"], sample["valid"])
        images, seen = self.images(sample["images"], sample["rig"]), self.seen(sample["rig"])
        return {**sample, "images": images, "seen": seen, "inverse_depth": inverse_depth, "valid": valid}

    def images(self, images: Mapping[str, Shaped[Tensor, "3 _ _"]], rig: CameraRig) -> Float[Tensor, "n 3 V"]:
        """Images on the icosphere, ``(n, 3, V)`` in [-1, 1], 0 where a camera does not look.

        Args:
            images: camera name -> ``(3, h, w)`` in [0, 1], or bytes.
            rig: unbatched.

        Raises:
            ShapeError: another image size than the calibration's.
            ArgumentError: other cameras than the rig's, or values far beyond [0, 1], such as floats up to 255.
        """
        values = self._intake_of(rig)(images)
        far = values.abs().mean()  # single pixels, such as those of a mask, may hold anything
        if not holds(~(far > FARTHEST)):
            raise ArgumentError(
                f"images: expected floats in [0, 1], got some of {float(far) / 2:g} on average; divide by the white "
                "value, or give uint8 as it is"
            )
        return values

    def seen(self, rig: CameraRig) -> Bool[Tensor, "n V"]:
        """Tell what of ``images`` was seen.

        Args:
            rig: unbatched.

        Returns:
            Bool ``(n, V)``: the vertex lies in the camera's field of view, its image and its mask.

        Examples:
            >>> from sphericalvision.cameras import ring_rig
            >>> seen = ToSphere(3).seen(ring_rig(4, image_size=(32, 32)))
            >>> seen.shape, bool(seen.any(0).all()), bool(seen.all())
            (torch.Size([4, 642]), True, False)
        """
        return self._intake_of(rig).seen

    def _intake_of(self, rig: CameraRig) -> Intake:
        """The tables of a rig, kept until another one comes."""
        if self._intake is None or self._intake.rig is not rig:
            self._intake = Intake(rig, self._grid, self.antialias)
        return self._intake

    @check_shapes
    def ground_truth(
        self, inverse_depth: Float[Tensor, "H W"], valid: Bool[Tensor, "H W"]
    ) -> tuple[Float[Tensor, " V_depth"], Bool[Tensor, " V_depth"]]:
        """Inverse depth and validity ``(V_depth,)`` at the vertices, of those of a panorama ``(H, W)``.

        Raises:
            ShapeError: no panorama (W = 2H or 4H).
        """
        if self._panorama is None or self._panorama.shape != inverse_depth.shape:
            check_panorama_size(*inverse_depth.shape)
            self._panorama = Equirectangular.with_square_pixels(*inverse_depth.shape)
        directions = self._depth_directions.to(inverse_depth.device)
        ids, inside = self._panorama.nearest(directions), self._panorama.contains(directions)
        mask = inside & valid.flatten()[ids]
        return torch.where(mask, inverse_depth.flatten()[ids], 0.0), mask

    def __repr__(self) -> str:
        return f"ToSphere(level={self.level}, depth_level={self.depth_level}, antialias={self.antialias})"


class RandomShift:
    """Move each camera's image by a random fraction of a pixel: "random shift" of the published training.

    Stands for calibration that is a little wrong: the rig in the sample stays as it was, so each camera's
    rays are off by a different small angle (half a pixel is 0.14 degrees for the published 220 degree
    images). Both components of each shift are normal with mean 0. Belongs before ``ToSphere``. What enters
    at the border repeats the border.

    Args:
        scale: standard deviation in pixels; 0.5 in the published training.
        generator: source of randomness; torch's global one when not given, which data loaders seed in each
            worker.

    References:
        Komatsu et al., IROS 2020, augmentation for real images.

    Examples:
        >>> images = {"cam1": torch.rand(3, 8, 8)}
        >>> shifted = RandomShift(0.5)({"images": images})["images"]["cam1"]
        >>> shifted.shape, torch.equal(shifted, images["cam1"])
        (torch.Size([3, 8, 8]), False)
    """

    def __init__(self, scale: float = 0.5, generator: torch.Generator | None = None) -> None:
        if not scale >= 0:
            raise ArgumentError(
                f"scale: expected a standard deviation in pixels of at least 0, got {scale!r}"
            )
        self.scale = scale
        self.generator = generator

    def __call__(self, sample: Sample) -> Sample:
        images = sample["images"]
        if isinstance(images, Tensor):
            raise ArgumentError("RandomShift: expected images by camera name; it belongs before ToSphere")
        from kornia.geometry.transform import translate  # a second to import

        shifted = {}
        for name, image in images.items():
            shift = self.scale * torch.randn(1, 2, generator=self.generator)
            shifted[name] = translate(image[None], shift.to(image), padding_mode="border")[0]
        return {**sample, "images": shifted}

    def __repr__(self) -> str:
        return f"RandomShift(scale={self.scale})"
