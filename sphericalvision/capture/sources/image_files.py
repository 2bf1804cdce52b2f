# SPDX-License-Identifier: Apache-2.0
"""Frames of image files, of each camera or with the views of all."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from torch import Tensor

from sphericalvision.capture.sources.frames import Recording
from sphericalvision.capture.sources.joined_views import size_of_view
from sphericalvision.core import FileFormatError
from sphericalvision.io.images import read_image, read_image_size

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".insp", ".tif", ".tiff", ".bmp", ".webp")


class ImageFiles(Recording):
    """Frames of image files; an image is read by its path."""

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Camera name -> (height, width) of its first image that can be read; the pixels are not."""
        if "" in next(iter(self.moments.values())):
            size = self._first_size("")
            return {} if size is None else dict.fromkeys(self.rig.names, size_of_view(size, self.whole))
        sizes = {name: self._first_size(name) for name in self.rig.names}
        return {name: size for name, size in sizes.items() if size is not None}

    def _first_size(self, name: str) -> tuple[int, int] | None:
        for files in list(self.moments.values())[:3]:
            with suppress(FileFormatError, OSError):
                return read_image_size(files[name])
        return None

    @contextmanager
    def opened(self) -> Iterator[Callable[[str, Any], Any]]:
        """A function that reads files, of the calibration's sizes; of all views, of the first one's size."""
        size_of_all = self._first_size("") if "" in next(iter(self.moments.values())) else None

        def read(camera: str, path: Path) -> Tensor:
            if camera:
                return read_image(path, self.rig.cameras[camera].image_size, f"the image of camera {camera}")
            picture = read_image(path, what="a picture of all views")
            height, width = size_of_all or picture.shape[-2:]
            if picture.shape[-2:] != (height, width):
                raise FileFormatError(
                    f"{path}: expected {width} x {height} pixels (width x height), as the first picture of all views "
                    f"has, got {picture.shape[-1]} x {picture.shape[-2]}"
                )
            return picture

        yield read
