# SPDX-License-Identifier: Apache-2.0
"""A camera's angles drawn over its image."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Bool, Shaped
from torch import Tensor

from sphericalvision.cameras import Camera, field_of_view
from sphericalvision.cameras.checks import check_image
from sphericalvision.geometry import angle_from_axis
from sphericalvision.viz.color import Picture
from sphericalvision.viz.figure import figure_pixels

_DPI = 150
_SAMPLES = 400  # angles are looked up at so many places along the longer side of the image
_GREY = "0.82"


@torch.no_grad()
def angle_map(
    camera: Camera,
    image: Shaped[Tensor, "c h w"] | None = None,
    mask: Bool[Tensor, "h w"] | None = None,
    title: str | None = None,
) -> Picture:
    """Draw the angle from the optical axis over the image: a contour every 10°, the edge of validity in red.

    Args:
        camera: a single camera.
        image: ``(c, h, w)`` in [0, 1], drawn below the contours; without it angles are coloured.
        mask: ``(h, w)``, True where usable; the rest is shaded.
        title: text above the picture; by default the model and its fields of view.

    Returns:
        uint8 ``(h, w, 3)``, RGB.

    Examples:
        >>> from sphericalvision.cameras import FisheyeCamera
        >>> angle_map(FisheyeCamera.from_field_of_view((300, 400), math.radians(190))).shape[-1]
        3
    """
    height, width = camera.image_size
    for name, value, shape in (("image", image, "(c, h, w)"), ("mask", mask, "(h, w)")):
        if value is not None:
            check_image(name, value, camera.image_size, shape)
    horizontal, vertical, widest = (math.degrees(angle) for angle in field_of_view(camera))
    step = max(max(height, width) / _SAMPLES, 1.0)
    u = torch.linspace(0, width - 1, round(width / step), dtype=torch.float64)
    v = torch.linspace(0, height - 1, round(height / step), dtype=torch.float64)
    pixels = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)
    directions, valid = camera.to("cpu", torch.float64).unproject(pixels)
    angle = np.ma.masked_where(~valid.numpy(), angle_from_axis(directions).rad2deg().numpy())

    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 5 * min(max(height / width, 0.4), 1.6) + 0.6), dpi=_DPI, layout="constrained")
    axes = figure.add_subplot()
    axes.set_facecolor(_GREY)
    extent = (-0.5, width - 0.5, height - 0.5, -0.5)
    ink = "black"
    if image is None:
        drawn = axes.imshow(angle, extent=extent, cmap="viridis_r", vmin=0, aspect="equal")
        figure.colorbar(drawn, label="angle from the axis (degrees)", fraction=0.04, aspect=30)
    else:
        picture = image.detach().cpu().float().clamp(0, 1).movedim(0, -1).numpy()
        axes.imshow(picture.squeeze(), extent=extent, cmap="gray", vmin=0, vmax=1, aspect="equal")
        ink = "#ffe14d"
    if mask is not None:
        shade = np.zeros((*camera.image_size, 4), np.float32)
        shade[..., 3] = 0.6 * (~mask.cpu().bool().numpy())
        axes.imshow(shade, extent=extent, aspect="equal", interpolation="nearest")
    widest_shown = float(angle.max()) if angle.count() else 0.0
    levels = np.arange(10, widest_shown, 10)
    if len(levels):
        lines = axes.contour(u.numpy(), v.numpy(), angle, levels, colors=ink, linewidths=0.8)
        axes.clabel(lines, fmt="%d°", fontsize=8)
    if not bool(valid.all()) and bool(valid.any()):
        axes.contour(u.numpy(), v.numpy(), valid.double().numpy(), [0.5], colors="red", linewidths=1.6)
    axis, on_axis = camera.to("cpu", torch.float64).project(
        torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    )
    if on_axis:
        axes.plot(*axis.tolist(), "+", color="red", markersize=9)
    model = f"{type(camera).__name__}, {width} x {height}"
    angles = f"{horizontal:.1f}° across, {vertical:.1f}° down, {widest:.1f}° at the widest"
    axes.set(xlim=extent[:2], ylim=extent[2:], xlabel="u (pixels)", ylabel="v (pixels)")
    axes.set_title(f"{title or model}\n{angles}", fontsize=10)
    return figure_pixels(figure)
