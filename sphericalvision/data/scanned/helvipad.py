# SPDX-License-Identifier: Apache-2.0
"""Helvipad: two panoramas, one above the other, and a LiDAR; ``sphericalvision-evaluate data=helvipad``.

Convention:
    A row looks at (1535 − 2 r) · π / 1920 from the nadir, r = 0 … 511: the latitudes −42° to 54°. Depth is metres from
    the bottom camera, the origin here; the top one is at (0, −0.191, 0).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras import CameraRig, EquirectangularCamera
from sphericalvision.core import FileFormatError, MissingFileError, check_choice
from sphericalvision.data.scanned.scanned_frames import Sample, ScannedFrames, read_raster
from sphericalvision.io.files import by_numbers
from sphericalvision.io.images import read_image_size
from sphericalvision.sphere import Equirectangular

BASELINE = 0.191
"""Metres from the bottom camera up to the top one."""
HELVIPAD_LATITUDES = (-math.pi * 7 / 30, math.pi * 3 / 10)
ROWS, COLUMNS = 512, 1920
PUBLISHED = {
    "PSMNet": (2.509, 5.673, 0.176, 1.809),
    "360SD-Net": (2.122, 5.077, 0.152, 0.904),
    "IGEV": (1.860, 4.447, 0.146, 1.203),
    "360-IGEV": (1.720, 4.297, 0.130, 0.388),
    "DFI-OmniStereo": (1.463, 3.767, 0.108, 0.397),
}
"""Depth MAE and RMSE in metres, MARE, and LRCE in metres, as published, on the older maps of depth."""


def disparity_from_depth(
    depth: Float[Tensor, "*batch h w"], directions: Float[Tensor, "h w 3"]
) -> Float[Tensor, "*batch h w"]:
    """Disparity in degrees, the angle at a point between the bottom and the top camera, by the law of sines.

    With the baseline B and the angle θ from the nadir, depth = B (sin θ / tan d − cos θ).

    Args:
        depth: ``(*b, h, w)`` metres from the bottom camera.
        directions: ``(h, w, 3)`` of the bottom camera.

    References:
        M. Zayene et al., "Helvipad: a real-world dataset for omnidirectional stereo depth estimation", CVPR 2025.

    Examples:
        >>> level = torch.tensor([[[0.0, 0.0, 1.0]]])
        >>> disparity_from_depth(torch.tensor([[0.191]]), level)  # as far away as the top camera is high
        tensor([[45.]])
    """
    down = directions[..., 1]
    across = torch.hypot(directions[..., 0], directions[..., 2])
    return torch.atan2(BASELINE * across, depth + BASELINE * down).rad2deg()


class HelvipadDataset(ScannedFrames):
    """Frames of Helvipad.

    ``root/{train,val,test}/images_top/<scene>/<frame>.jpg``, ``images_bottom`` and ``depth_maps`` alike, as published,
    or smaller by a whole factor. The true depth of the bottom camera and its augmented form, which the metrics of the
    set want, are the entries ``strip_depth`` and ``strip_depth_augmented``, 0 where unknown.

    Args:
        split: "train", "val" or "test".
        augmented: learn from the augmented maps of depth, which are denser, and interpolated.

    References:
        M. Zayene et al., "Helvipad: a real-world dataset for omnidirectional stereo depth estimation", CVPR 2025.
    """

    def __init__(
        self,
        root: str | Path,
        split: str = "train",
        height: int = 160,
        transform: Callable[[Sample], Any] | None = None,
        augmented: bool = False,
    ) -> None:
        super().__init__(root, height, transform)
        check_choice("split", split, ("train", "val", "test"))
        self.folder = self.root / split
        if not self.folder.is_dir():
            raise MissingFileError(
                f"{self.folder.absolute()}: no such folder; Helvipad comes with its splits train, val and test"
            )
        self.truth_folder = "depth_maps_augmented" if augmented else "depth_maps"
        bottom = self.folder / "images_bottom"
        names = sorted(
            (str(p.relative_to(bottom).with_suffix("")) for p in bottom.glob("*/*.jpg")), key=by_numbers
        )
        cameras = ("bottom", "top")
        frames = (
            (
                name,
                {camera: self.folder / f"images_{camera}" / f"{name}.jpg" for camera in cameras},
                self.folder / self.truth_folder / f"{name}.png",
            )
            for name in names
        )
        self.take(frames, f"images_top, images_bottom and {self.truth_folder} in {split}/")
        size = read_image_size(bottom / f"{self.names[0]}.jpg")
        if size[0] * COLUMNS != size[1] * ROWS:
            raise FileFormatError(
                f"{bottom / self.names[0]}.jpg: expected {COLUMNS} x {ROWS} pixels or a part of it, got "
                f"{size[1]} x {size[0]}"
            )
        self.strip = Equirectangular(*size, latitudes=HELVIPAD_LATITUDES)
        camera = EquirectangularCamera(size, latitudes=HELVIPAD_LATITUDES)
        poses = torch.eye(4).repeat(2, 1, 1)
        poses[1, 1, 3] = -BASELINE
        self.fixed_rig = CameraRig(dict.fromkeys(cameras, camera), poses)

    def points(self, name: str) -> Tensor:
        """Points of the bottom camera's map of depth."""
        depth = self._depth(name, self.truth_folder)
        return (depth[..., None] * self.strip.directions)[depth > 0]

    def more(self, name: str) -> Sample:
        """The bottom camera's depth, for metrics."""
        path = self.folder / "depth_maps_augmented" / f"{name}.png"
        plain = self._depth(name, "depth_maps")
        augmented = self._depth(name, "depth_maps_augmented") if path.is_file() else torch.zeros_like(plain)
        return {"strip_depth": plain, "strip_depth_augmented": augmented}

    def _depth(self, name: str, folder: str) -> Tensor:
        return read_raster(self.folder / folder / f"{name}.png", 256.0, self.strip.shape, "depth")
