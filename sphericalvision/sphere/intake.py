# SPDX-License-Identifier: Apache-2.0
"""``Intake``: from the images of a rig's cameras to the input of a network.

``as_photographs`` converts images as programs hold them: numpy or torch, 8 bits or float, grey or colour.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.remapping.area import as_floats
from sphericalvision.cameras.rig import check_images_of
from sphericalvision.cameras.sphere_images import SphereLookup, sphere_lookups
from sphericalvision.core import ArgumentError, ShapeError, check_floating
from sphericalvision.icosphere import Icosphere

CHANNELS = (1, 3, 4)
"""Grey, colour, and colour with alpha, which is dropped."""
PILLOW_MODES = ("L", "RGB", "RGBA", "I;16", "F")
"""Modes of Pillow whose numbers are brightness."""


class Intake:
    """The images of a rig's cameras as a network takes them; what follows from the rig is computed once.

    Each camera is turned into world orientation; its position plays no part. Values are looked up bilinearly.

    Convention:
        Cameras give values in [0, 1], networks take them in [-1, 1], and 0 where nothing was seen.

    Args:
        rig: unbatched.
        grid: on which the images are looked up; None for the cameras' own images, which must be of one size then.
        antialias: average images over the area between the vertices first where they are finer.

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
        self, images: Mapping[str, Shaped[Tensor, "*batch 3 _ _"]]
    ) -> Float[Tensor, "*batch_and_size"]:
        """Return images ``(*b, n, 3, *size)`` in [-1, 1], cameras in the rig's order, 0 where not seen.

        Args:
            images: camera name -> ``(*b, 3, h, w)`` in [0, 1], or bytes.

        Raises:
            ShapeError: another image size than the calibration's.
            ArgumentError: other cameras than the rig's, or images of other integers.
        """
        for name, image in images.items():
            if image.dtype != torch.uint8:
                check_floating(f"images[{name!r}]", image)
        return signed(self.looked_up(self.averaged(images)), self.seen)

    def averaged(
        self, images: Mapping[str, Shaped[Tensor, "*batch c _ _"]]
    ) -> dict[str, Float[Tensor, "*batch c _ _"]]:
        """Return the smaller images in which values are looked up, in the rig's order; arguments as in a call."""
        check_images_of(self.rig, images)
        if not self.lookups:
            return {name: as_floats(images[name]) for name in self.rig.names}
        pairs = zip(self.rig.names, self.lookups, strict=True)
        return {name: look.averaged(images[name]) for name, look in pairs}

    def looked_up(
        self, averaged: Mapping[str, Shaped[Tensor, "*batch c _ _"]]
    ) -> Shaped[Tensor, "*batch_and_size"]:
        """Return the values of ``averaged`` images in their own range, as a new tensor."""
        if not self.lookups:
            return torch.stack(list(averaged.values()), -4)
        pairs = zip(self.lookups, averaged.values(), strict=True)
        return torch.stack([look.places(image) for look, image in pairs], -3)

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
    values = images.mul(2).sub_(1)
    return values if seen is None else values.mul_(seen.unsqueeze(1))


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


def as_photographs(images: Mapping[str, Any], rig: CameraRig) -> dict[str, Float[Tensor, "*batch 3 _ _"]]:
    """Return camera name -> float32 ``(*b, 3, h, w)`` in [0, 1], in the order of the rig's cameras.

    Args:
        images: by camera name, numpy arrays or tensors ``(h, w)``, ``(h, w, c)`` or ``(c, h, w)``, c = 1, 3 or 4,
            or batches of such; unsigned integers from 0 to the greatest of their type, or floats in [0, 1].
        rig: of the cameras, whose sizes ``(h, w)`` are checked.

    Raises:
        ArgumentError: images of other cameras than the rig's, or values out of range.
        ShapeError: an image has another size than its camera, or the images are not equally many.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(2, image_size=(8, 10))
        >>> grey = {name: np.full((8, 10), 255, np.uint8) for name in rig.names}
        >>> as_photographs(grey, rig)["cam1"].shape, as_photographs(grey, rig)["cam1"].max()
        (torch.Size([3, 8, 10]), tensor(1.))
    """
    return {name: as_colors(image) for name, image in ordered_images(images, rig).items()}


def as_colors(image: Shaped[Tensor, "*batch c h w"]) -> Float[Tensor, "*batch 3 h w"]:
    """Return float32 in [0, 1] of three channels, of bytes or of such floats with 1, 3 or 4 channels.

    Examples:
        >>> as_colors(torch.tensor([[[255]], [[0]], [[51]]], dtype=torch.uint8)).flatten()
        tensor([1.0000, 0.0000, 0.2000])
    """
    return three_channels(as_floats(image))


def three_channels(image: Shaped[Tensor, "*batch c h w"]) -> Shaped[Tensor, "*batch 3 h w"]:
    """View an image with 1, 3 or 4 channels as one with 3, values as they are."""
    if image.shape[-3] == 1:
        return image.expand(*image.shape[:-3], 3, *image.shape[-2:])
    return image[..., :3, :, :]


def ordered_images(images: Mapping[str, Any], rig: CameraRig) -> dict[str, Shaped[Tensor, "*batch c _ _"]]:
    """Return camera name -> ``(*b, c, h, w)`` in the order of the rig's cameras, bytes as they are, others as floats.

    Nothing is copied that need not be; arguments and errors as of ``as_photographs``.
    """
    if not isinstance(images, Mapping):
        raise ArgumentError(
            f"images: expected a mapping {{camera name: image}}, got {type(images).__name__}; "
            "dict(zip(rig.names, images)) makes one of a list in the rig's order"
        )
    if set(images) != set(rig.names):
        raise ArgumentError(
            f"images: expected one for each of {', '.join(rig.names)}, got {', '.join(map(str, images)) or 'none'}; "
            "rig.subset([...]) is a rig of fewer cameras"
        )
    ordered = {name: _channels_first(name, images[name], rig.cameras[name].image_size) for name in rig.names}
    batches = {name: tuple(image.shape[:-3]) for name, image in ordered.items()}
    if len(set(batches.values())) > 1:
        raise ShapeError(f"images: expected equally many of each camera, got batches {batches}")
    return ordered


def _channels_first(name: str, image: Any, size: tuple[int, int]) -> Tensor:
    """One camera's image in any layout as ``(*b, c, h, w)``."""
    values = _as_tensor(name, image)
    height, width = size
    if values.ndim in (3, 4) and values.shape[-3:-1] == size and values.shape[-1] in CHANNELS:
        values = values.movedim(-1, -3)
    elif values.ndim in (3, 4) and values.shape[-2:] == size and values.shape[-3] in CHANNELS:
        pass
    elif values.ndim in (2, 3) and values.shape[-2:] == size:
        values = values.unsqueeze(-3)
    else:
        raise ShapeError(
            f"images[{name!r}]: expected {height} x {width} (height x width) as calibrated, grey (h, w) or colour "
            f"(h, w, 3) or (3, h, w), with or without a batch before it, got shape {tuple(values.shape)}. For whole "
            f"images that were resized, rig.resized({{{name!r}: (height, width)}}) is the rig"
        )
    return values


def _as_tensor(name: str, image: Any) -> Tensor:
    """The values as they are in bytes, or as float32 in [0, 1]."""
    # Of Pillow: to numpy a palette is grey, and CMYK, YCbCr and HSV are colours.
    mode = getattr(image, "mode", None)
    if isinstance(mode, str) and mode not in PILLOW_MODES:
        raise ArgumentError(
            f"images[{name!r}]: expected a picture of mode {', '.join(PILLOW_MODES)}, got {mode}; convert it by "
            'image.convert("RGB")'
        )
    array = image if isinstance(image, Tensor) else np.asarray(image)
    kind = str(getattr(array.dtype, "name", array.dtype)).removeprefix("torch.")  # in either order of bytes
    bits = kind.removeprefix("uint") if kind.startswith("uint") else None
    if bits is None and "float" not in kind:
        raise ArgumentError(f"images[{name!r}]: expected uint8, uint16 or float in [0, 1], got {array.dtype}")
    if isinstance(array, np.ndarray):  # torch takes none that is read-only
        array = torch.from_numpy(np.require(array, np.uint8 if bits == "8" else np.float32, ["C", "W"]))
    if array.device.type == "meta":
        raise ArgumentError(
            f"images[{name!r}]: expected values, got a tensor on the device 'meta', which has none"
        )
    if array.layout != torch.strided:
        raise ArgumentError(
            f"images[{name!r}]: expected a dense tensor, got {array.layout}; image.to_dense() makes one"
        )
    if not array.numel():
        raise ShapeError(f"images[{name!r}]: expected one image or more, got shape {tuple(array.shape)}")
    values = array if bits == "8" else array.float()
    if bits == "16" or (bits == "8" and values.device.type == "cpu"):  # a GPU would be waited for
        from sphericalvision.io.images import warn_of_bits

        warn_of_bits(int(values.max()), f"images[{name!r}]", int(bits))
    if bits == "8":
        return values
    if bits is not None:
        return values / (2 ** int(bits) - 1)
    least, most = (float(value) for value in values.detach().aminmax())
    if not (least >= -0.01 and most <= 1.01):  # also where one is NaN
        raise ArgumentError(
            f"images[{name!r}]: expected floats in [0, 1], got {least:g} to {most:g}; divide by the white value, or "
            "give uint8 as it is"
        )
    return values
