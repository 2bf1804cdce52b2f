# SPDX-License-Identifier: Apache-2.0
"""WideDepth: indoor scenes from three fisheyes of up to 195°, and depth to the millimetre; ``data=widedepth``.

Convention:
    ``CENTER`` is the origin; ``RIGHT`` stands a baseline to the right of it, ``DOWN`` a baseline below; all are turned
    alike. Depth is metres along the ray. The set has no calibration: unless one is given, the lens is taken for
    equidistant, with its field of view from the left to the right edge.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sphericalvision.cameras import Camera, CameraRig, FisheyeCamera, read_camera
from sphericalvision.core import FileFormatError, MissingFileError, check_choice
from sphericalvision.data.scanned.scanned_frames import Sample, ScannedFrames, read_raster
from sphericalvision.io.images import read_image_size

FIELDS_OF_VIEW = (120, 140, 165, 195)
BASELINES = (20, 65, 120, 200, 300)
PLACES = {"center": (0.0, 0.0), "right": (1.0, 0.0), "down": (0.0, 1.0)}
"""Baselines to the right and down."""
STEREO = {"horizontal": ("center", "right"), "vertical": ("center", "down"), "both": tuple(PLACES)}


class WideDepthDataset(ScannedFrames):
    """Frames of the benchmark of WideDepth, one a scene: fisheye images, and the depth of the one in the centre.

    ``root/<scene>/195FOV/65mm/{CENTER,RIGHT,DOWN}/fisheye.png`` and ``CENTER/depth/fisheye.png``, 16 bits in
    millimetres, 0 where unknown; scenes are called like ``001_057_000``.

    Args:
        scenes: names of some of them; all when not given.
        field_of_view: degrees from the left to the right edge: 120, 140, 165 or 195.
        baseline: millimetres: 20, 65, 120, 200 or 300.
        stereo: which cameras: ``"horizontal"``, center and right, ``"vertical"``, center and down, or ``"both"``.
        calibration: file of the lens, in the size of the images.

    Raises:
        ArgumentError: a field of view, baseline or choice of cameras that the set does not have.
        FileFormatError: a calibration of another image size.

    References:
        I. Indyk et al., "WideDepth: millimeter-accurate benchmark for fisheye depth estimation", ICRA 2026.
    """

    def __init__(
        self,
        root: str | Path,
        scenes: Sequence[str] | None = None,
        height: int = 160,
        transform: Callable[[Sample], Any] | None = None,
        field_of_view: int = 195,
        baseline: int = 65,
        stereo: str = "horizontal",
        calibration: str | Path | None = None,
    ) -> None:
        super().__init__(root, height, transform)
        check_choice("field_of_view", field_of_view, FIELDS_OF_VIEW)
        check_choice("baseline", baseline, BASELINES)
        check_choice("stereo", stereo, tuple(STEREO))
        baseline_folder = Path(f"{field_of_view}FOV", f"{baseline}mm")
        names = sorted(p.name for p in self.root.glob("*") if re.fullmatch(r"\d{3}_\d{3}_\d{3}", p.name))
        for scene in scenes or ():
            if scene not in names:
                raise MissingFileError(
                    f"{self.root.absolute()}: no scene {scene!r}; it has {len(names)}, {', '.join(names[:3])} ..."
                )
        folders = {
            scene: self.root / scene / baseline_folder for scene in (names if scenes is None else scenes)
        }
        frames = (
            (
                scene,
                {camera: folder / camera.upper() / "fisheye.png" for camera in STEREO[stereo]},
                folder / "CENTER" / "depth" / "fisheye.png",
            )
            for scene, folder in folders.items()
        )
        self.take(
            frames,
            f"<scene>/{baseline_folder} with fisheye.png of {', '.join(STEREO[stereo])} and CENTER/depth",
        )
        camera = self._lens(field_of_view, calibration)
        poses = torch.eye(4).repeat(len(STEREO[stereo]), 1, 1)
        poses[:, :2, 3] = torch.tensor([PLACES[name] for name in STEREO[stereo]]) * baseline / 1000
        self.fixed_rig = CameraRig(dict.fromkeys(STEREO[stereo], camera), poses)
        self.rays = camera.unproject(camera.pixel_grid())

    def _lens(self, field_of_view: int, calibration: str | Path | None) -> Camera:
        first = self.images[self.names[0]]["center"]
        height, width = read_image_size(first)
        if calibration is not None:
            camera = read_camera(calibration)
            if camera.image_size != (height, width):
                raise FileFormatError(
                    f"{calibration}: expected a camera of {height} x {width} pixels (height x width), as {first} has, "
                    f"got {camera.image_size[0]} x {camera.image_size[1]}"
                )
            return camera
        warnings.warn(
            f"{self.root}: the set tells no lens; it is taken for equidistant, {field_of_view}° from the left to the "
            "right edge. calibration=... gives another.",
            stacklevel=3,
        )
        angle = math.radians(field_of_view)
        center = [(width - 1) / 2, (height - 1) / 2]
        return FisheyeCamera("equidistant", [width / angle] * 2, center, (height, width), angle / 2)

    def points(self, name: str) -> Tensor:
        """Points of the centre camera's map of depth."""
        camera = self.fixed_rig.cameras["center"]
        depth = read_raster(self.truths[name], 1000.0, camera.image_size, "depth")
        valid = (depth > 0) & self.rays.valid
        return (depth[..., None] * self.rays.directions)[valid]
