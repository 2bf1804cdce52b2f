# SPDX-License-Identifier: Apache-2.0
"""``Intake``: from the images that the cameras of a rig took to what a network takes."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.sphere_images import SphereLookup, sphere_lookups
from sphericalvision.core import ShapeError
from sphericalvision.icosphere import Icosphere

__all__ = ["Intake", "pixels_seen", "signed", "unsigned"]


class Intake:
    """The images of a rig's cameras as a network takes them; what follows from the rig is computed once.

    Each camera is turned into world orientation; its position plays no part. Values are looked up bilinearly.

    Convention:
        Cameras give values in [0, 1], networks take them in [-1, 1], and 0 where nothing was seen.

    Args:
        rig: unbatched.
        grid: that the images are looked up on; None for the cameras' own images, which must be of one size then.
        antialias: average images over the area between the vertices first, where they are finer.

    Attributes:
        rig: as given.
        seen: ``(n, *size)``, size being ``(V,)`` or ``(h, w)``: inside the field of view, the image and the mask.
        lookups: where the vertices fall in the image of each camera; none without a grid.

    Raises:
        ShapeError: the cameras' own images are wanted, and their sizes differ.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(3, image_size=(24, 24))
        >>> images = {name: torch.rand(3, 24, 24) for name in rig.names}
        >>> Intake(rig, Icosphere(3))(images).shape, Intake(rig, None)(images).shape
        (torch.Size([3, 3, 642]), torch.Size([3, 3, 24, 24]))
    """

    def __init__(self, rig: CameraRig, grid: Icosphere | None, antialias: bool = True) -> None:
        self.rig = rig
        self.lookups: list[SphereLookup] = []
        if grid is not None:
            vertices = grid.vertices.to(rig.world_from_camera)
            self.lookups = sphere_lookups(rig, vertices, antialias)
            self.seen: Bool[Tensor, " n *size"] = torch.stack([look.seen for look in self.lookups])
            return
        sizes = sorted({camera.image_size for camera in rig.cameras.values()})
        if len(sizes) > 1:
            raise ShapeError(
                f"images: expected cameras with images of one size for this network, got {sizes}; rig.resized(...) is "
                "the rig of resized images"
            )
        self.seen = torch.stack(list(pixels_seen(rig).values()))

    def __call__(
        self, images: Mapping[str, Float[Tensor, "*batch 3 _ _"]]
    ) -> Float[Tensor, "*batch_and_size"]:
        """Return images ``(*b, n, 3, *size)`` in [-1, 1], cameras in the rig's order, 0 where not seen.

        Args:
            images: camera name -> ``(*b, 3, h, w)`` in [0, 1].

        Raises:
            ShapeError: other cameras than the rig's, or another image size than the calibration's.
        """
        return signed(self.looked_up(images), self.seen)

    def looked_up(
        self, images: Mapping[str, Shaped[Tensor, "*batch c _ _"]]
    ) -> Shaped[Tensor, "*batch_and_size"]:
        """Return the values as they are, without a change of range: a tensor of their own. Arguments as of a call."""
        self.check(images)
        ordered = [images[name] for name in self.rig.names]
        if not self.lookups:
            return torch.stack(ordered, -4)
        return torch.stack([look(image, 0) for look, image in zip(self.lookups, ordered, strict=True)], -3)

    def check(self, images: Mapping[str, Shaped[Tensor, "*batch c _ _"]]) -> None:
        """Raise ``ShapeError`` unless there is an image of each camera, in the size of its calibration."""
        if set(images) != set(self.rig.names):
            raise ShapeError(
                f"images: expected those of the cameras {list(self.rig.names)}, got {list(images)}"
            )
        for name, camera in self.rig.cameras.items():
            if tuple(images[name].shape[-2:]) != tuple(camera.image_size):
                raise ShapeError(
                    f"images[{name!r}]: expected (h, w) = {tuple(camera.image_size)} from the calibration, got "
                    f"{tuple(images[name].shape[-2:])}"
                )

    def __repr__(self) -> str:
        return f"Intake({self.rig}, onto {tuple(self.seen.shape[1:])})"


def signed(
    images: Float[Tensor, "*batch_and_size"], seen: Bool[Tensor, " n *size"] | None = None
) -> Float[Tensor, "*batch_and_size"]:
    """Return images ``(*b, n, c, *size)`` of [0, 1] in [-1, 1], 0 where not seen.

    Examples:
        >>> signed(torch.tensor([[[0.0, 0.25, 1.0]]]), torch.tensor([[True, True, False]]))
        tensor([[[-1.0000, -0.5000,  0.0000]]])
    """
    values = images * 2 - 1
    return values if seen is None else torch.where(seen.unsqueeze(1), values, 0.0)


def unsigned(images: Float[Tensor, "*images"]) -> Float[Tensor, "*images"]:
    """Return images of [-1, 1] in [0, 1]: the inverse of ``signed``.

    Examples:
        >>> unsigned(signed(torch.tensor([[[0.0, 0.25, 1.0]]])))
        tensor([[[0.0000, 0.2500, 1.0000]]])
    """
    return (images + 1) / 2


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
