# SPDX-License-Identifier: Apache-2.0
"""Deep360: four panoramas at the corners of a square, on rendered roads; ``data=deep360``.

Convention:
    Pictures and depth are in Cassini's projection: a column is an angle from the plane between left and right, and
    rows go from the back over the top, the front and the bottom to the back again. Turned a quarter to the left such a
    picture is an equirectangular one whose pole is to the right, and that is how it is taken here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, EquirectangularCamera
from sphericalvision.core import FileFormatError, MissingFileError, check_choice
from sphericalvision.data.scanned.scanned_frames import Sample, ScannedFrames
from sphericalvision.io.arrays import read_npz
from sphericalvision.io.files import by_numbers
from sphericalvision.io.images import read_image, read_image_size
from sphericalvision.sphere import Equirectangular

FOLDERS = {"train": "training", "val": "validation", "test": "testing"}
FARTHEST = 1000.0
"""Metres: what is as far away, the sky, is unknown."""
PICTURES = {"cam1": "12_rgb1", "cam2": "12_rgb2", "cam3": "34_rgb3", "cam4": "34_rgb4"}
"""Of each camera, those of the six pairs of pictures that are turned as camera 1 is."""
PLACES = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, -1.0]])
"""Metres: 2 to the right of 1, 3 behind it, and 4 behind 2."""
OURS_FROM_TURNED = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


class Deep360Dataset(ScannedFrames):
    """Frames of Deep360: clean pictures, and the depth of camera 1.

    ``root/ep{1..6}_500frames/{training,validation,testing}/rgb/<frame>_<pair>_rgb<camera>.png`` and
    ``depth/<frame>_depth.npz``, pictures of 1024 x 512 pixels (h x w), or smaller. Its truth is rendered, not scanned,
    and goes the same way: what camera 1 sees, as seen from the rig's centre.

    Args:
        split: "train", "val" or "test".

    Raises:
        FileFormatError: pictures that are not twice as high as wide.

    References:
        M. Li et al., "MODE: multi-view omnidirectional depth estimation with 360° cameras", ECCV 2022.
    """

    def __init__(
        self,
        root: str | Path,
        split: str = "train",
        height: int = 160,
        transform: Callable[[Sample], Any] | None = None,
    ) -> None:
        super().__init__(root, height, transform)
        check_choice("split", split, tuple(FOLDERS))
        folders = sorted(self.root.glob(f"ep*_500frames/{FOLDERS[split]}"), key=by_numbers)
        if not folders:
            raise MissingFileError(
                f"{self.root.absolute()}: no ep1_500frames/{FOLDERS[split]} or alike; Deep360 comes with its splits "
                f"{', '.join(FOLDERS.values())}"
            )
        frames = (frame for folder in folders for frame in self._frames(folder))
        self.take(frames, f"rgb and depth in ep*_500frames/{FOLDERS[split]}")
        first = self.images[self.names[0]]["cam1"]
        rows, columns = read_image_size(first)
        if rows != 2 * columns:
            raise FileFormatError(
                f"{first}: expected 512 x 1024 pixels or a part of it, got {columns} x {rows}"
            )
        camera = EquirectangularCamera((columns, rows))
        poses = torch.eye(4).repeat(4, 1, 1)
        poses[:, :3, :3], poses[:, :3, 3] = OURS_FROM_TURNED, PLACES
        self.fixed_rig = CameraRig(dict.fromkeys(PICTURES, camera), poses)
        self.rays = Equirectangular(columns, rows).directions @ OURS_FROM_TURNED.T

    @staticmethod
    def _frames(folder: Path) -> Iterator[tuple[str, dict[str, Path], Path]]:
        """Name, pictures and depth of the frames of a split in one of the six parts."""
        for depth in sorted((folder / "depth").glob("*_depth.npz"), key=by_numbers):
            frame = depth.stem.removesuffix("_depth")
            files = {
                camera: folder / "rgb" / f"{frame}_{picture}.png" for camera, picture in PICTURES.items()
            }
            yield f"{folder.parent.name}/{folder.name}/{frame}", files, depth

    def image(self, name: str, camera: str, size: tuple[int, int]) -> Tensor:
        """A picture, turned a quarter to the left."""
        upright = read_image(self.images[name][camera], size[::-1], f"{name} of {camera}")
        return torch.rot90(upright, 1, (1, 2)).contiguous()

    def points(self, name: str) -> Tensor:
        """Points of camera 1's map of depth."""
        path, size = self.truths[name], self.rays.shape[1::-1]
        arrays = read_npz(path, ["arr_0"], 128 * math.prod(size), "depth")
        depth = arrays["arr_0"].squeeze()
        if depth.shape != tuple(size) or depth.dtype.kind not in "fiu":
            raise FileFormatError(
                f"{path}: expected depth of {size[0]} rows and {size[1]} columns, got {depth.dtype} {depth.shape}; "
                "truth and images have to be of one size"
            )
        turned = torch.from_numpy(np.rot90(depth).astype(np.float32))
        valid = (turned > 0) & (turned < FARTHEST)
        return (turned[..., None] * self.rays)[valid]
