# SPDX-License-Identifier: Apache-2.0
"""Pages that show depth estimates: a panorama to turn in, with image, depth, confidence, error, and points to orbit."""

from __future__ import annotations

import base64
import html
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.remapping.lookup import pixels_a_radian
from sphericalvision.capture.panoramas import Panoramas
from sphericalvision.capture.result import Depth
from sphericalvision.io.files import write_bytes
from sphericalvision.io.images import as_bytes
from sphericalvision.sweep import index_from_depth
from sphericalvision.viz.color import colorize, depth_to_color, error_to_color, fade
from sphericalvision.viz.panorama import confidence_strength

HERE = Path(__file__).parent
MOST_POINTS, FEWEST_POINTS = 100_000, 20_000
"""In a page of one frame, and of each frame of many."""
MOST_ROWS = 1536
"""Of the panorama of the images of one frame."""
MOST_FRAMES = 100
"""On a time line."""
MOST_ERROR = 10.0
"""Percent of N: the bright end of errors."""
MOST_REACH = 3.0
"""Of a view from outside, in median distances: a sky is far away."""


def save_viewer(
    path: str | Path,
    depth: Depth,
    height: int = 512,
    title: str = "depth all around",
    near: float | None = None,
    truth: Float[Tensor, "*grid"] | None = None,
) -> Path:
    """Write a self-contained HTML page of one frame and return its path; it opens from disk, without a network.

    Args:
        path: of the page, one to three megabytes.
        depth: of one frame.
        height: rows of the panoramas in it; that of the images is as fine as the images are.
        title: of the page.
        near: metres, the red end of the colours of depth; about the nearest of the frame when not given.
        truth: true depth in ``depth.directions``, metres, for a picture of errors; NaN where it is not known.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.scenes import make_scene, render_rig
        >>> from sphericalvision.capture import Predictor
        >>> predictor = Predictor(ring_rig(4, image_size=(64, 64)), method="semi_global", level=4, min_depth=0.5)
        >>> save_viewer("room.html", predictor(render_rig(make_scene("room", seed=1), predictor.rig)), height=32).name
        'room.html'
    """
    page = Timeline(height, title, near, MOST_POINTS, max(height, min(rows_like(depth.rig), MOST_ROWS)))
    page.add("", depth, truth)
    return page.save(path)


class Timeline:
    """A page of several frames, with a time line to go from one to the other, or to play them.

    Memory and page stay bounded: of more than 100 frames every second is kept, and so on.

    Args:
        height: rows of the panoramas in it.
        title: of the page.
        near: metres, the red end of the colours of depth; about the nearest of the first frame when not given.
        most_points: of a frame.
        image_height: rows of the panorama of the images; as of the others when not given.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.scenes import make_scene, render_rig
        >>> from sphericalvision.capture import Predictor
        >>> predictor = Predictor(ring_rig(4, image_size=(64, 64)), method="semi_global", level=4, min_depth=0.5)
        >>> page = Timeline(height=32)
        >>> for seed in (1, 2):
        ...     page.add(f"room {seed}", predictor(render_rig(make_scene("room", seed=seed), predictor.rig)))
        >>> page.save("rooms.html").name, len(page)
        ('rooms.html', 2)
    """

    def __init__(
        self,
        height: int = 256,
        title: str = "depth all around",
        near: float | None = None,
        most_points: int = FEWEST_POINTS,
        image_height: int | None = None,
    ) -> None:
        self.image_height = height if image_height is None else image_height
        self.height, self.title, self.near, self.most_points = height, title, near, most_points
        self._frames: list[dict[str, Any]] = []
        self._radius = self._reach = 1.0
        self._number, self._every = 0, 1

    def __len__(self) -> int:
        return len(self._frames)

    @torch.inference_mode()
    def add(self, name: str, depth: Depth, truth: Float[Tensor, "*grid"] | None = None) -> None:
        """Add a frame at the end; ``truth`` as of ``save_viewer``, for all frames or for none."""
        self._number += 1
        if (self._number - 1) % self._every:
            return
        views = Panoramas(depth, self.height, self.near)
        self.near, panorama = views.near, views.panorama
        fine = views if self.image_height == self.height else Panoramas(depth, self.image_height, self.near)
        sure = panorama.confidence.where(panorama.seen, math.nan)
        strength = confidence_strength(panorama.confidence, panorama.seen)
        pictures = {
            "image": as_bytes(fine.colors[0]),
            "depth": fade(depth_to_color(panorama.depth, self.near), strength),
            "confidence": colorize(sure.numpy(), "viridis"),
        }
        if truth is not None:
            number, nearest = depth.network.num_hypotheses, depth.min_depth
            index = index_from_depth(truth.to(depth.index), number, nearest)
            true = Panoramas(replace(depth, index=index), self.height, self.near).panorama
            error = (100 * (number - 1) / number) * nearest * (1 / panorama.depth - 1 / true.depth)
            pictures["error"] = error_to_color(error, MOST_ERROR)
        cloud = depth.points()
        number = min(len(cloud.points), self.most_points)
        chosen = torch.linspace(0, len(cloud.points) - 1, number).round().long()
        # y up and looking along -z, as three.js has it
        points = (cloud.points[chosen] - depth.rig.center.to(cloud.points)).cpu()
        points = points * torch.tensor([1.0, -1.0, -1.0])
        if not self._frames and len(points):
            distances = points.norm(dim=-1)
            self._radius = float(distances.median())
            self._reach = min(float(distances.quantile(0.9)), MOST_REACH * self._radius)
        levels = (cloud.colors[chosen].clamp(0, 1) * 255).round().byte()
        urls = [{"name": key, "url": _data_url(picture)} for key, picture in pictures.items()]
        encoded = {"points": _base64(points.float()), "colors": _base64(levels)}
        self._frames.append({"name": name, "pictures": urls, **encoded})
        if len(self._frames) > MOST_FRAMES:
            self._frames, self._every = self._frames[::2], 2 * self._every

    def save(self, path: str | Path) -> Path:
        """Write the page and return its path."""
        near = self.near or 1.0
        bar = depth_to_color(near / torch.linspace(1.0, 0.0, 256).repeat(8, 1), near)
        facts = "evenly in 1/m; greyer where less sure; grey: no two cameras"
        if self._frames and len(self._frames[0]["pictures"]) > 3:
            facts += f"; error: black 0, yellow {MOST_ERROR:.0f} % of N and more"
        values = {
            "TITLE": html.escape(self.title),
            "FACTS": facts,
            "NEAR": f"{near:.3g} m",
            "BAR": _data_url(bar),
            # The end of a script is no end of this one, whatever a frame is called.
            "DATA": json.dumps(
                {"frames": self._frames, "radius": self._radius, "reach": self._reach}
            ).replace("<", r"\u003c"),
            "LIBRARY": (HERE / "three.min.js").read_text(encoding="utf-8"),
            "SCRIPT": (HERE / "viewer.js").read_text(encoding="utf-8"),
        }
        template = (HERE / "viewer.html").read_text(encoding="utf-8")
        # In one pass, so that nothing that comes from elsewhere is taken for a place of the template.
        page = re.sub("__([A-Z]+)__", lambda place: values[place[1]], template)
        # A title may be the name of a file in another encoding
        write_bytes(path, page.encode(errors="replace"))
        return Path(path)


def rows_like(rig: CameraRig) -> int:
    """Return the rows of a panorama with as many pixels a radian as the finest camera has in its middle.

    Examples:
        >>> from sphericalvision.cameras import EquirectangularCamera
        >>> rows_like(CameraRig([EquirectangularCamera((100, 200))], torch.eye(4)[None]))
        100
    """
    return round(math.pi * max(pixels_a_radian(camera) for camera in rig.cameras.values()))


def _data_url(picture: npt.NDArray[Any]) -> str:
    """A picture as a JPEG inside of an address."""
    pixels = np.ascontiguousarray(picture[..., ::-1])  # blue first
    _, encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 92])
    return f"data:image/jpeg;base64,{base64.b64encode(encoded.tobytes()).decode()}"


def _base64(values: Tensor) -> str:
    return base64.b64encode(values.contiguous().cpu().numpy().tobytes()).decode()
