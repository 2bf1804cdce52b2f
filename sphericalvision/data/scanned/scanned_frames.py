# SPDX-License-Identifier: Apache-2.0
"""``ScannedFrames``: the base of captures with scanned points."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.data import Dataset

from sphericalvision.cameras import CameraRig
from sphericalvision.core import FileFormatError, MissingFileError
from sphericalvision.data.collate import Sample
from sphericalvision.data.truth import truth_from_points
from sphericalvision.io.images import read_image, read_pages
from sphericalvision.sphere import Equirectangular
from sphericalvision.sphere.intake import pixels_seen

NOISE = 0.02
"""Metres: standard deviation of a LiDAR's distances, as those of these sets are specified."""


class ScannedFrames(Dataset[Sample]):
    """Frames with images of a rig and scanned points; the truth is what is seen of the points from the rig's centre.

    Samples are those of ``OmniStereoDataset``, with the truth on a panorama of the whole sphere. A layout is a
    subclass that finds ``names`` and ``images``, and returns the ``points`` of a frame and, if frames differ in it,
    its ``rig``. Each takes these arguments and further ones.

    Args:
        root: folder of the set.
        height: rows of the panorama of truth around the rig's centre; it has twice as many columns.
        transform: callable that gets each sample and returns what the data set shall return.

    Attributes:
        names: of the frames.
        images: frame -> camera name -> file.
        truths: frame -> file of its points, if ``take`` was called.
        fixed_rig: of all frames, if it is the same.
        left_out: sentences about frames that lack something.

    Raises:
        MissingFileError: the folder, a split or files of the set are missing, or no frame is complete.
    """

    root_name = "root"
    """What the folder is called where it is given."""
    names: list[str]
    images: Mapping[str, Mapping[str, Path]]
    truths: Mapping[str, Path]
    fixed_rig: CameraRig

    def __init__(
        self, root: str | Path, height: int = 160, transform: Callable[[Sample], Any] | None = None
    ) -> None:
        self.root, self.transform = Path(root), transform
        if not self.root.is_dir():
            raise MissingFileError(f"{self.root_name}: {self.root.absolute()} is not a folder")
        self.panorama = Equirectangular(height, 2 * height)
        self.left_out: list[str] = []
        self._warned = False

    def rig(self, name: str) -> CameraRig:
        """The rig of a frame, in whose world the points are."""
        return self.fixed_rig

    def image(self, name: str, camera: str, size: tuple[int, int]) -> Float[Tensor, "3 h w"]:
        """An image of a frame, of a camera of this size."""
        return read_image(self.images[name][camera], size, f"{name} of {camera}")

    def points(self, name: str) -> Float[Tensor, "P 3"]:
        """Points of a frame in the rig's world, metres."""
        raise NotImplementedError(f"{type(self).__name__}.points")

    def more(self, name: str) -> Sample:
        """Further entries of a sample, which metrics of the set's own want."""
        return {}

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Any:
        name = self.names[index]
        rig, points = self.rig(name), self.points(name)
        depth, valid = truth_from_points(points, self.panorama, rig.center, noise=NOISE)
        self._warn_of_another_frame(rig, points, float(valid.float().mean()), name)
        sample: Sample = {
            "images": {
                camera: self.image(name, camera, rig.cameras[camera].image_size)
                for camera in self.images[name]
            },
            "seen": pixels_seen(rig),
            "inverse_depth": torch.where(valid, 1 / depth.clamp(min=1e-3), 0.0),
            "valid": valid,
            "rig": rig,
            "frame": name,
            **self.more(name),
        }
        return sample if self.transform is None else self.transform(sample)

    def _warn_of_another_frame(self, rig: CameraRig, points: Tensor, share_known: float, name: str) -> None:
        fraction = float(rig.project(points).valid.any(0).float().mean()) if len(points) else 0.0
        problem = ""
        if fraction < 0.5:
            problem = f"cameras see {fraction:.0%} of the points of {name}; expected half of them or more"
        elif share_known < 0.01:
            problem = f"points of {name} tell the depth of {share_known:.1%} of all directions; expected 1 % or more"
        if problem and not self._warned:
            self._warned = True
            warnings.warn(
                f"{self.root}: {problem}. Are the points in the frame of the rig (x right, y down, z forward, metres), "
                "and is the scanner's pose right?",
                stacklevel=3,
            )

    def take(self, frames: Iterable[tuple[str, Mapping[str, Path], Path]], where: str) -> None:
        """Have the frames of which all files are there: the name of each, its images by camera, and its truth."""
        images: dict[str, Mapping[str, Path]] = {}
        truths: dict[str, Path] = {}
        lacking: dict[str, str] = {}
        for name, files, truth in frames:
            images[name], truths[name] = files, truth
            if missing := [file for file in (*files.values(), truth) if not file.is_file()]:
                lacking[name] = str(missing[0].relative_to(self.root))
        self.images, self.truths = images, truths
        self.names = self.complete(list(images), lacking, where)

    def complete(self, wanted: Sequence[str], lacking: Mapping[str, str], where: str) -> list[str]:
        """Those of the wanted frames that lack nothing; the others are counted in ``left_out``."""
        complete = [name for name in wanted if name not in lacking]
        first = next(iter(lacking.items()), ("", ""))
        if not complete:
            why = f" The first, {first[0]}, lacks {first[1]}." if lacking else ""
            raise MissingFileError(f"{self.root.absolute()}: no complete frame; expected {where}.{why}")
        if lacking:
            self.left_out.append(
                f"{self.root}: {len(lacking)} of {len(wanted)} frames were left out; the first, {first[0]}, lacks "
                f"{first[1]}"
            )
        return complete

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.root)!r}, {len(self)} frames)"


def read_raster(path: str | Path, scale: float, size: tuple[int, int], what: str) -> Float[Tensor, "h w"]:
    """A raster of truth ``(h, w)``: 16-bit values are divided by ``scale``, floating point ones are as they are.

    Raises:
        FileFormatError: another size, or another kind of file; 8-bit pictures are shown, not measured.
    """
    page = read_pages(path, what)[-1]
    if page.ndim != 2 or page.dtype not in (np.uint16, np.float32, np.float64) or page.shape != tuple(size):
        raise FileFormatError(
            f"{path}: expected {what} of {size[0]} rows and {size[1]} columns, 16 bits or floating point, got "
            f"{page.dtype} {page.shape}; truth and images have to be of one size"
        )
    return torch.from_numpy(page.astype(np.float32) / np.float32(scale if page.dtype == np.uint16 else 1.0))
