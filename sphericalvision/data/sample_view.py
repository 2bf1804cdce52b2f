# SPDX-License-Identifier: Apache-2.0
"""``SampleView``: the images and the depth of a sample, as networks take them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.data.augmentation.transforms import ToSphere
from sphericalvision.data.collate import Sample
from sphericalvision.data.omnistereo.ground_truth import check_panorama_size
from sphericalvision.icosphere.topology import check_level
from sphericalvision.sphere.intake import Intake


@dataclass(frozen=True)
class SampleView:
    """The entries of samples for networks; those that are None or False are neither rendered nor looked up.

    Attributes:
        level: of the icosphere with images: ``images`` ``(n, 3, V)`` in [-1, 1], 0 where not ``seen`` ``(n, V)`` (in
            the field of view and in the mask).
        depth_level: of the icosphere with depth from the rig's centre: ``inverse_depth`` ``(V_depth,)`` in 1/m, 0 at
            infinity, and ``valid`` ``(V_depth,)``.
        images: whether there are the cameras' own images: ``fisheye`` ``(n, 3, H, W)`` in [-1, 1], 0 where not
            ``fisheye_seen`` ``(n, H, W)``.
        panorama: (height, width) of ``panorama_inverse_depth`` and ``panorama_valid``: W = 2H is the full sphere, W =
            4H the latitudes within 45°. Sets on disk have a size of their own.
        antialias: average images over the area between vertices, for images much finer than the icosphere.

    Raises:
        ArgumentError: levels out of range, or nothing at all.
        ShapeError: the panorama is neither of the two.

    Examples:
        >>> SampleView(level=5, depth_level=3)
        SampleView(level=5, depth_level=3, images=False, panorama=None, antialias=False)
    """

    level: int | None = None
    depth_level: int | None = None
    images: bool = False
    panorama: tuple[int, int] | None = None
    antialias: bool = False

    def __post_init__(self) -> None:
        for level in (self.level, self.depth_level):
            if level is not None:
                check_level(level)
        if self.panorama is not None:
            check_panorama_size(*self.panorama)
        if self.level is None and self.depth_level is None and not self.images and self.panorama is None:
            raise ArgumentError(
                "view: expected a level, a depth_level, images or a panorama, got none of them"
            )


class ToView:
    """Transform of a sample of a set on disk into one with the entries of a view.

    Images are looked up as by ``ToSphere``. Depth at vertices is taken from the nearest pixel of the panorama. Tables
    are kept while samples have the same rig object.

    Examples:
        >>> import torch
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(2, image_size=(24, 24))
        >>> images = {name: torch.rand(3, 24, 24) for name in rig.names}
        >>> truth = {"inverse_depth": torch.ones(16, 32), "valid": torch.ones(16, 32, dtype=torch.bool)}
        >>> list(ToView(SampleView(depth_level=2, images=True))({"images": images, "rig": rig, **truth}))
        ['rig', 'fisheye', 'fisheye_seen', 'inverse_depth', 'valid']
    """

    def __init__(self, view: SampleView) -> None:
        self.view = view
        level, depth_level = view.level or 0, view.depth_level or 0
        self._to_sphere = ToSphere(level, depth_level, view.antialias)
        self._intake: Intake | None = None

    def images(self, images: Mapping[str, Tensor], rig: CameraRig) -> dict[str, Tensor]:
        """The entries of images, made of camera name -> ``(3, h, w)`` in [0, 1], and their masks of seen pixels."""
        entries: dict[str, Tensor] = {}
        if self.view.level is not None:
            entries |= {"images": self._to_sphere.images(images, rig), "seen": self._to_sphere.seen(rig)}
        if self.view.images:
            if self._intake is None or self._intake.rig is not rig:
                self._intake = Intake(rig, None)
            entries |= {"fisheye": self._intake(images), "fisheye_seen": self._intake.seen}
        return entries

    def __call__(self, sample: Sample) -> Sample:
        truth = sample["inverse_depth"], sample["valid"]
        replaced = ("images", "seen", "inverse_depth", "valid")
        entries: Sample = {key: value for key, value in sample.items() if key not in replaced}
        entries |= self.images(sample["images"], sample["rig"])
        if self.view.depth_level is not None:
            entries["inverse_depth"], entries["valid"] = self._to_sphere.ground_truth(*truth)
        if self.view.panorama is not None:
            entries["panorama_inverse_depth"], entries["panorama_valid"] = truth
        return entries

    def __repr__(self) -> str:
        return f"ToView({self.view})"
