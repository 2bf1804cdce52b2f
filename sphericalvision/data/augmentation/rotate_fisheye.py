# SPDX-License-Identifier: Apache-2.0
"""Samples as rotated cameras would have taken them: existing images, looked up through turned cameras."""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras import CameraRig, Remap
from sphericalvision.cameras.rig import check_images_of
from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.data.collate import Sample
from sphericalvision.shapes import check_shapes
from sphericalvision.sphere.intake import pixels_seen


class RotateFisheye:
    """Turn the cameras of a sample where they stand, and make the images that they would have taken.

    For images that cannot be rendered again, such as OmniHouse's. Outside the field of view, the image or the mask of
    the original nothing is known: there images are 0, and ``seen`` (camera name -> ``(h, w)``) and the masks of the
    sample's new rig are False. Positions stay, so depth from the rig's centre stays true, and
    ground truth is passed on as it is. Belongs before ``ToSphere``. Where images shrink they are averaged.

    Tables are kept while samples come with one and the same rig object; the new rig is one object, too.

    Args:
        tilt: radians by which every camera looks further down, as ``rig.rotated`` means it; a number, or ``(n,)``.
        rotation: ``(3, 3)``, or ``(n, 3, 3)`` one for each camera, in the camera's own frame and after the tilt: what
            the turned camera sees in direction d lies in ``rotation @ d`` for the camera as it was.
        image_size: (height, width) of the new images; each as before when not given.
        mode: of ``remap``: "area", or "bilinear", which is faster and may alias.

    Raises:
        ArgumentError: an unknown mode, or, when called, images that are not by the names of the rig's cameras.
        ShapeError: a rotation of another shape; when called, images of another size than their cameras'.

    References:
        Komatsu et al. (2020), section IV-C: rigs whose cameras look down by up to 45°.

    Examples:
        >>> import math
        >>> import torch
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(4, image_size=(32, 32))
        >>> images = {name: torch.ones(3, 32, 32) for name in rig.names}
        >>> tilted = RotateFisheye(tilt=math.radians(45))({"images": images, "rig": rig})
        >>> tilted["rig"].axes[0]  # the front camera looks forward and down
        tensor([0.0000, 0.7071, 0.7071])
        >>> round(tilted["rig"].masks["cam1"].float().mean().item(), 2)  # of the image; 0.79 is the whole circle
        0.62
    """

    @check_shapes
    def __init__(
        self,
        tilt: float | Tensor = 0.0,
        rotation: Float[Tensor, "*cameras 3 3"] | None = None,
        image_size: Sequence[int] | None = None,
        mode: str = "area",
    ) -> None:
        check_choice("mode", mode, ("area", "bilinear"))
        self.tilt, self.rotation, self.image_size, self.mode = tilt, rotation, image_size, mode
        self._before: CameraRig | None = None
        self._after: CameraRig | None = None
        self._seen: dict[str, Tensor] = {}
        self._remaps: dict[str, Remap] = {}

    def __call__(self, sample: Sample) -> Sample:
        images, rig = sample["images"], sample["rig"]
        if isinstance(images, Tensor):
            raise ArgumentError("RotateFisheye: expected images by camera name; it belongs before ToSphere")
        check_images_of(rig, images)
        if self._before is not rig:
            after = self.turned(rig)
            before_from_world = rig.world_from_camera[..., :3, :3].mT
            after_from_before = (before_from_world @ after.world_from_camera[..., :3, :3]).mT
            self._remaps = {
                name: Remap(rig.cameras[name], after.cameras[name], turn, self.mode, mask=rig.masks.get(name))
                for name, turn in zip(rig.names, after_from_before, strict=True)
            }
            masks = {name: remap.mask() for name, remap in self._remaps.items()}
            self._before, self._after = rig, after.replaced(masks=masks)
            self._seen = pixels_seen(self._after)
        turned = {name: self._remaps[name](images[name]) for name in rig.names}
        return {**sample, "images": turned, "seen": dict(self._seen), "rig": self._after}

    def turned(self, rig: CameraRig) -> CameraRig:
        """The rig with its cameras turned, and their images of the new size; without masks."""
        poses = rig.rotated(tilt=self.tilt).world_from_camera.clone()
        if self.rotation is not None:
            poses[..., :3, :3] = poses[..., :3, :3] @ self.rotation.to(poses)
        turned = rig.replaced(world_from_camera=poses, masks={})
        return turned if self.image_size is None else turned.resized(self.image_size)

    def __repr__(self) -> str:
        return f"RotateFisheye(tilt={self.tilt}, rotation={self.rotation}, image_size={self.image_size})"
