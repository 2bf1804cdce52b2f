# SPDX-License-Identifier: Apache-2.0
"""Hints in files, one for each frame: points, depth images of cameras, panoramas of depth, or an earlier result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.hints import Hint, inverse_of
from sphericalvision.capture.sources.patterns import find_files, find_labels
from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.data.point_files import MOST_COLUMNS, POINT_SUFFIXES, read_points
from sphericalvision.io.arrays import read_npy, read_npz
from sphericalvision.io.images import read_pages
from sphericalvision.sphere import Equirectangular
from sphericalvision.sphere.resampling.views import Views

MILLIMETRES = 1000.0
MOST = 65535
"""That 16 bits hold: what is farther, or was not measured."""


class HintFiles:
    """The hints of frames, read as they are asked for.

    =========================  ==================================================================================
    file                       content
    =========================  ==================================================================================
    ``.ply`` ``.pcd`` ``.bin`` points of a scanner in the frame of the calibration, metres; ``.csv`` and ``.xyz``, too
    ``.npy``                   such points ``(P, 3)``; or an image of depth
    image                      depth: 16 bits in millimetres, 0 and 65535 where unknown, or floating point in
                               metres, 0 and infinite where unknown; of each camera where the pattern has
                               ``{camera}``, in proportion; else a panorama, twice as wide as high
    ``.npz``                   as ``sphericalvision-predict outputs=[npz]`` writes it
    =========================  ==================================================================================

    Args:
        pattern: of the files, with ``{frame}``, and ``{camera}`` where each camera has one.
        names: of the frames.
        rig: whose images have depth.
        placement: ``(4, 4)``, from the frame of the calibration to that of the rig in use.
        quantity: of depth images: ``"range"`` along the ray, ``"z"`` along the camera's axis.
        fit: as of ``Hint``; with ``"affine"`` images hold inverse depth.
        whole: names of all cameras of the calibration, which say what ``{camera}`` stands for; those of the rig when
            not given.

    Raises:
        MissingFileError: a frame has no file.
        ArgumentError: the pattern has other fields, or a quantity is given of what has none.
    """

    def __init__(
        self,
        pattern: str,
        names: Sequence[str],
        rig: CameraRig,
        placement: Float[Tensor, "4 4"],
        quantity: Literal["range", "z"] = "range",
        fit: Literal["metres", "scale", "affine"] = "metres",
        whole: Sequence[str] | None = None,
    ) -> None:
        self.rig, self.placement, self.quantity, self.fit = rig, placement, quantity, fit
        self.of_cameras = "{camera" in pattern
        if quantity != "range" and not self.of_cameras:
            raise ArgumentError(
                f"hint_quantity: {quantity} is for depth images of cameras, with {{camera}} in the pattern, got "
                f"{pattern!r}; leave it out"
            )
        cameras = rig.names if self.of_cameras else ("",)
        labels = find_labels(pattern, whole, cameras, key="hint") if whole and self.of_cameras else None
        frames = names if "{frame" in pattern else None
        files = find_files(pattern, cameras, frames, key="hint", labels=labels).frames
        if frames is None and len(names) > 1:
            raise ArgumentError(f"hint: {pattern!r} has no {{frame}}, there are {len(names)} frames")
        self._files = dict(zip(names, files.values(), strict=True))

    def __call__(self, frame: str) -> Hint:
        """Read the hint of a frame.

        Raises:
            FileFormatError: a file is damaged, holds something else, or nothing that is known.
        """
        try:
            return self._read(self._files[frame])
        except ValueError as error:  # everything but the fit comes from the files
            if isinstance(error, FileFormatError) or str(error).startswith("hint_fit: "):
                raise
            first, *others = self._files[frame].values()
            more = " and those of the other cameras" if others else ""
            raise FileFormatError(f"{first}{more}: {str(error).removeprefix('hint: ')}") from None

    def _read(self, files: Mapping[str, Path]) -> Hint:
        if self.of_cameras:
            images = {name: _image(path)[None] for name, path in files.items()}
            for name, image in images.items():
                (height, width), (rows, columns) = self.rig.cameras[name].image_size, image.shape[-2:]
                if abs(height * columns - width * rows) > max(height, width):
                    raise FileFormatError(
                        f"{files[name]}: expected {width} x {height} or the same in proportion, got {columns} x {rows}"
                    )
            rig = self.rig.resized({name: image.shape[-2:] for name, image in images.items()})
            return Hint.of_views(Views(images, rig), self.quantity, self.fit)
        (path,) = files.values()
        suffix = path.suffix.lower()
        if suffix == ".npz":
            keys = ("directions", "inverse_depth", "confidence")
            arrays = read_npz(path, keys, what="as sphericalvision-predict outputs=[npz] writes them")
            directions, inverse_depth, confidence = (
                torch.from_numpy(arrays[key].astype(np.float32)) for key in keys
            )
            return Hint.of_directions(directions, inverse_depth, confidence, fit=self.fit)
        is_points = suffix in POINT_SUFFIXES and suffix != ".npy"
        values = None if is_points else _image(path)
        if values is None or (suffix == ".npy" and values.shape[1] <= MOST_COLUMNS):
            if self.fit == "affine":
                raise ArgumentError("hint_fit: affine is for images of inverse depth, got points")
            points = read_points(path).double() @ self.placement[:3, :3].mT.double() + self.placement[:3, 3]
            return Hint.of_points(points - self.rig.origin.to(points), fit=self.fit)
        height, width = values.shape
        if width != 2 * height:
            raise FileFormatError(
                f"{path}: expected a panorama of depth, twice as wide as high, got {height} x {width}; images of the "
                "cameras need {camera} in the pattern"
            )
        if self.fit != "affine":
            values = inverse_of(values)
        return Hint.of_directions(Equirectangular(height, width).directions, values, fit=self.fit)


def _image(path: Path) -> Tensor:
    """An array ``(h, w)`` of depth in metres, or of whatever unit."""
    page: Any = read_npy(path) if path.suffix.lower() == ".npy" else read_pages(path, "depth")[-1]
    if page.ndim != 2 or (page.dtype != np.uint16 and page.dtype.kind != "f"):
        raise FileFormatError(
            f"{path}: expected depth (h, w), 16 bits in millimetres or floating point in metres, got {page.dtype} "
            f"{page.shape}; pictures in colours show depth, they do not hold it"
        )
    values = torch.from_numpy(page.astype(np.float32))
    return values if page.dtype != np.uint16 else values.where(values < MOST, torch.inf) / MILLIMETRES
