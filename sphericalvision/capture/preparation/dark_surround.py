# SPDX-License-Identifier: Apache-2.0
"""Where the image circle of a lens ends, in its images: beyond, they are dark in all frames.

Calibrations of some programs do not tell a field of view. The black around the circle would then be taken for image,
which agrees with nothing that other cameras see there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.rig import CameraRig

SAMPLES = 400
"""Rows or columns of the image that are looked at, about."""
STEP = math.radians(1)
"""Between rings around the optical axis."""
FEWEST = 20
"""Pixels in a ring that counts."""
DARK = 0.06
"""Of values in [0, 1], up to which a pixel is dark: black levels, noise and JPEG are below."""
BRIGHT = 0.12
"""From which on a pixel is bright; vignetting leads through what is between."""
INSIDE, OUTSIDE = 0.7, 0.01
"""Shares: of bright pixels at least in the rings within the edge, and at most of pixels that are not dark beyond."""
RINGS, BLURRED, DARK_RINGS = 6, 4, 3
"""Rings within the edge; that the edge itself may cover, as circles are not quite concentric; and beyond, at least."""


def without_dark_surround(
    rig: CameraRig, frames: Iterable[Mapping[str, Float[Tensor, "3 h w"]]]
) -> tuple[CameraRig, dict[str, float]]:
    """The rig whose fields of view end where its images do, and radians from the axis of the cameras that changed.

    Args:
        rig: whose fields of view may reach beyond the image circles.
        frames: some; what is dark in all of them is beyond.
    """
    images = list(frames)
    angles = {}
    for name, camera in rig.cameras.items() if images else ():
        angle = dark_beyond(camera, [frame[name] for frame in images], rig.masks.get(name))
        if angle is not None:
            angles[name] = angle
    cameras = {name: rig.cameras[name].with_max_angle(angle) for name, angle in angles.items()}
    return (rig.replaced({**rig.cameras, **cameras}) if angles else rig), angles


@torch.no_grad()
def dark_beyond(
    camera: Camera, images: Sequence[Float[Tensor, "3 h w"]], mask: Bool[Tensor, "h w"] | None = None
) -> float | None:
    """Radians from the optical axis beyond which all images are dark; None where that is not clear.

    It is clear where rings around the axis are bright up to some angle, dark from a few degrees later on, and three
    degrees of the field of view or more are dark.

    Args:
        camera: of the images.
        images: values in [0, 1].
        mask: ``(h, w)``, True where they are usable; the rest says nothing.

    Examples:
        >>> from sphericalvision.cameras import FisheyeCamera
        >>> whole = FisheyeCamera.from_field_of_view((128, 128), math.radians(220))
        >>> v, u = torch.meshgrid(torch.arange(128.0), torch.arange(128.0), indexing="ij")
        >>> image = ((u - 63.5).hypot(v - 63.5) < 52).float().expand(3, 128, 128)
        >>> round(math.degrees(dark_beyond(whole, [image])))  # 52 of 64 pixels, which are 110°
        89
        >>> dark_beyond(whole, [torch.ones(3, 128, 128)]), dark_beyond(whole, [torch.zeros(3, 128, 128)])
        (None, None)
    """
    height, width = camera.image_size
    stride = max(1, min(height, width) // SAMPLES)
    rows, columns = torch.arange(0, height, stride), torch.arange(0, width, stride)
    brightest = torch.stack([image[..., ::stride, ::stride].amax(0).cpu() for image in images]).amax(0)
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    directions, valid = camera.to("cpu", torch.float64).unproject(torch.stack((u, v), -1).double())
    if mask is not None:
        valid = valid & mask[::stride, ::stride].cpu()
    angles = torch.atan2(directions[..., :2].norm(dim=-1), directions[..., 2])
    rings = (angles[valid] / STEP).long()
    counts = rings.bincount(minlength=1)
    fractions, bright = (
        rings.bincount((brightest[valid] > limit).double()) / counts.clamp(min=1) for limit in (DARK, BRIGHT)
    )
    # The last ring with few pixels is a part of its neighbour.
    last = max((counts >= FEWEST).nonzero().flatten().tolist(), default=-1)
    fractions = fractions[: last + 1]
    edge = max((fractions >= 0.5).nonzero().flatten().tolist(), default=0)
    outside = fractions[edge + BLURRED :]
    if edge < RINGS or len(outside) < DARK_RINGS or float(outside.max()) > OUTSIDE:
        return None
    if float(bright[edge - RINGS : edge].mean()) < INSIDE:
        return None
    return (edge + float(fractions[edge] > 0.9)) * STEP
