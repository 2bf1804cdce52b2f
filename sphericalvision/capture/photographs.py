# SPDX-License-Identifier: Apache-2.0
"""Images as programs hold them (numpy or torch, 8 bits or float, grey or colour) to tensors of a rig's cameras."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError, ShapeError

__all__ = ["as_photographs"]

CHANNELS = (1, 3, 4)
"""Grey, colour, and colour with alpha, which is dropped."""


def as_photographs(
    images: Mapping[str, Any], rig: CameraRig, channels: str = "rgb"
) -> dict[str, Float[Tensor, "*batch 3 _ _"]]:
    """Return camera name -> float32 ``(*b, 3, h, w)`` in [0, 1], in the order of the rig's cameras.

    Args:
        images: by camera name, numpy arrays or tensors ``(h, w)``, ``(h, w, c)`` or ``(c, h, w)``, c = 1, 3 or 4,
            or batches of such; unsigned integers from 0 to the greatest of their type, or floats in [0, 1].
        rig: says the sizes ``(h, w)``.
        channels: order of the channels of colour images, "rgb", or "bgr" as OpenCV has it.

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
    if not isinstance(images, Mapping):
        raise ArgumentError(
            f"images: expected a mapping {{camera name: image}}, got {type(images).__name__}; "
            "dict(zip(rig.names, images)) makes one of a list in the rig's order"
        )
    missing = [name for name in rig.names if name not in images]
    if missing:
        raise ArgumentError(
            f"images: there is none of {', '.join(missing)}; the rig has {', '.join(rig.names)}, the images are of "
            f"{', '.join(map(str, images)) or 'no camera'}. rig.subset([...]) is a rig of fewer cameras"
        )
    unknown = [str(name) for name in images if name not in rig.cameras]
    if unknown:
        raise ArgumentError(
            f"images: {', '.join(unknown)} are no cameras of the rig ({', '.join(rig.names)})"
        )
    found = {
        name: _photograph(name, images[name], rig.cameras[name].image_size, channels) for name in rig.names
    }
    batches = {name: tuple(image.shape[:-3]) for name, image in found.items()}
    if len(set(batches.values())) > 1:
        raise ShapeError(f"images: expected equally many of each camera, got batches {batches}")
    return found


def _photograph(name: str, image: Any, size: tuple[int, int], channels: str) -> Tensor:
    """Float32 ``(*b, 3, h, w)`` of one camera's image in any layout."""
    values = _scaled(name, image)
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
    if values.shape[-3] == 1:
        return values.expand(*values.shape[:-3], 3, height, width)
    values = values[..., :3, :, :]
    return values.flip(-3) if channels == "bgr" else values


def _scaled(name: str, image: Any) -> Tensor:
    """The values as float32 in [0, 1]."""
    array = image if isinstance(image, Tensor) else np.asarray(image)
    kind = str(array.dtype).removeprefix("torch.")
    bits = kind.removeprefix("uint") if kind.startswith("uint") else None
    if bits is None and "float" not in kind:
        raise ArgumentError(f"images[{name!r}]: expected uint8, uint16 or float in [0, 1], got {array.dtype}")
    if isinstance(array, np.ndarray):  # torch takes none that is read-only
        array = torch.from_numpy(np.require(array, np.uint8 if bits == "8" else np.float32, ["C", "W"]))
    values = array.float()
    if bits is not None:
        return values / (2 ** int(bits) - 1)
    if values.numel():
        least, most = (float(value) for value in values.detach().aminmax())
        if not (least >= -0.01 and most <= 1.01):  # also where one is NaN
            raise ArgumentError(
                f"images[{name!r}]: expected floats in [0, 1], got {least:g} to {most:g}; divide by the white value, "
                "or give uint8 as it is"
            )
    return values
