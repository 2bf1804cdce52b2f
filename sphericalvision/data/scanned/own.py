# SPDX-License-Identifier: Apache-2.0
"""Your own capture with a scan for each frame: ``sphericalvision-evaluate data=scanned``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import MissingFileError
from sphericalvision.data.point_files import POINT_SUFFIXES, read_points
from sphericalvision.data.scanned.scanned_frames import Sample, ScannedFrames
from sphericalvision.geometry import transform_points
from sphericalvision.io.times import SAME_TIME, are_counts, nearest_in_time, seconds


class OwnScans(ScannedFrames):
    """Frames of image files, and a file of points for each.

    A frame's scan is the file of its name; or, where both names are times, the one nearest in time, at most
    ``tolerance`` away. Frames without one are left out and counted.

    Args:
        images: frame -> camera name -> file.
        rig: of the cameras.
        folder: of the scans, in files that ``read_points`` reads.
        rig_from_scanner: ``(4, 4)`` takes points of the scanner to the rig's world.
        tolerance: seconds.
        columns: numbers of a point in ``.bin`` files, as in ``read_points``.

    Raises:
        MissingFileError: no scan, or none that belongs to a frame.
    """

    root_name = "points"

    def __init__(
        self,
        images: Mapping[str, Mapping[str, Path]],
        rig: CameraRig,
        folder: str | Path,
        rig_from_scanner: Float[Tensor, "4 4"] | None = None,
        height: int = 160,
        transform: Callable[[Sample], Any] | None = None,
        tolerance: float = SAME_TIME,
        columns: int | None = None,
    ) -> None:
        super().__init__(folder, height, transform)
        self.images, self.fixed_rig = images, rig
        self.rig_from_scanner = torch.eye(4) if rig_from_scanner is None else rig_from_scanner
        self.columns = columns
        files = sorted(path for path in self.root.iterdir() if not path.name.startswith("."))
        scans = {
            path.name.removesuffix(path.suffix).removesuffix(".pcd"): path
            for path in files
            if path.suffix in POINT_SUFFIXES
        }
        if not scans:
            raise MissingFileError(
                f"points: {self.root.absolute()} holds no {', '.join(POINT_SUFFIXES)}; expected a scan for each frame"
            )
        matches = {name: name for name in images if name in scans}
        if not are_counts(list(images)) and not are_counts(list(scans)):
            nearest = nearest_in_time(seconds(list(images)), seconds(list(scans)), tolerance)
            stems = list(scans)
            in_time = {n: stems[at] for n, at in zip(images, nearest, strict=True) if at is not None}
            matches = in_time | matches
        lacking = {name: "a scan of its name or time" for name in images if name not in matches}
        where = f"a scan for each frame, called as it, or at a time at most {tolerance:g} s away"
        self.names = self.complete(list(images), lacking, where)
        self.scans = {name: scans[scan] for name, scan in matches.items()}

    def points(self, name: str) -> Tensor:
        """Those of the scan, in the rig's world, from its origin."""
        scan = read_points(self.scans[name], columns=self.columns)
        points = transform_points(self.rig_from_scanner.double(), scan.double())
        return (points - self.fixed_rig.origin.to(points)).float()
