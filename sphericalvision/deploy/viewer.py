# SPDX-License-Identifier: Apache-2.0
"""A page that shows a depth estimate: a panorama to turn in, its image, depth and confidence, and points to orbit."""

from __future__ import annotations

import base64
import html
import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from sphericalvision.deploy.depth import Depth
from sphericalvision.deploy.pictures import near_end_of
from sphericalvision.io.files import write_bytes
from sphericalvision.viz.color import colorize, depth_to_color, fade
from sphericalvision.viz.panorama import confidence_strength, rgb_panorama

__all__ = ["save_viewer"]

HERE = Path(__file__).parent
MOST_POINTS = 100_000


@torch.inference_mode()
def save_viewer(
    path: str | Path,
    depth: Depth,
    height: int = 512,
    title: str = "depth all around",
    near: float | None = None,
) -> Path:
    """Write a self-contained HTML page of one frame and return its path; it opens from disk, without a network.

    Args:
        path: of the page, about a megabyte.
        depth: of one frame.
        height: rows of the panoramas in it.
        title: of the page.
        near: metres, the red end of the colours of depth; about the nearest of the frame when not given.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.data import make_scene, render_rig
        >>> from sphericalvision.deploy import Predictor
        >>> rig = ring_rig(4, image_size=(64, 64))
        >>> predictor = Predictor(rig, method="semi_global", level=4, min_depth=0.5)
        >>> save_viewer("room.html", predictor(render_rig(make_scene("room", seed=1), rig)), height=32).name
        'room.html'
    """
    panorama = depth.panorama(height)
    near = near_end_of(depth) if near is None else near
    images = {name: image.cpu() for name, image in depth.images.items()}
    colors, _ = rgb_panorama(depth.rig.to("cpu"), images, height, panorama.depth.cpu())
    sure = panorama.confidence.where(panorama.seen, math.nan).cpu()
    strength = confidence_strength(panorama.confidence, panorama.seen).cpu()
    pictures = {
        "image": (colors.clamp(0, 1) * 255).byte().movedim(0, -1).numpy(),
        "depth": fade(depth_to_color(panorama.depth, near), strength),
        "confidence": colorize(sure.numpy(), "viridis"),
    }
    cloud = depth.points()
    chosen = torch.linspace(0, len(cloud.points) - 1, min(len(cloud.points), MOST_POINTS)).round().long()
    # y up and looking along -z, as three.js has it
    points = (cloud.points[chosen] - depth.rig.center.to(cloud.points)).cpu() * torch.tensor(
        [1.0, -1.0, -1.0]
    )
    levels = (cloud.colors[chosen].clamp(0, 1) * 255).round().byte()
    data = {
        "pictures": [{"name": name, "url": _data_url(picture)} for name, picture in pictures.items()],
        "points": _base64(points.float()),
        "colors": _base64(levels),
        "radius": float(points.norm(dim=-1).median()) if len(points) else 1.0,
    }
    facts = f"red {near:.3g} m, dark blue far away; greyer where less sure, grey where fewer than two cameras look"
    page = (HERE / "viewer.html").read_text(encoding="utf-8")
    for mark, text in (
        ("__TITLE__", html.escape(title)),
        ("__FACTS__", facts),
        ("__NUMBER__", str(len(points))),
        ("__DATA__", json.dumps(data)),
        ("__SCRIPT__", (HERE / "viewer.min.js").read_text(encoding="utf-8")),
    ):
        page = page.replace(mark, text)
    write_bytes(path, page.encode())
    return Path(path)


def _data_url(picture: npt.NDArray[Any]) -> str:
    """A picture as a JPEG inside of an address."""
    _, encoded = cv2.imencode(
        ".jpg", np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 92]
    )
    return f"data:image/jpeg;base64,{base64.b64encode(encoded.tobytes()).decode()}"


def _base64(values: Tensor) -> str:
    return base64.b64encode(values.contiguous().cpu().numpy().tobytes()).decode()
