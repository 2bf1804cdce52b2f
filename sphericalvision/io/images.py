# SPDX-License-Identifier: Apache-2.0
"""Images from and to disk as tensors: reads say what is wrong, writes appear whole or not at all."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch

from sphericalvision.core import FileFormatError, MissingFileError, ShapeError, check_file

__all__ = ["list_folder", "read_image", "read_pages", "whole_file", "write_image", "write_pages"]

Array = npt.NDArray[Any]


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Give a temporary name beside ``path``; move it onto ``path`` when the block ends well, else remove it.

    An interrupted program therefore never leaves half a file that a later run would take for a whole one.

    Examples:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> with whole_file(folder / "note.txt") as temporary:
        ...     _ = temporary.write_text("done")
        >>> [file.name for file in folder.iterdir()]
        ['note.txt']
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}-{uuid.uuid4().hex}{path.suffix}")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def read_pages(path: str | Path, what: str = "an image") -> list[Array]:
    """Read all pages of an image file as stored (colour pages as RGB), without scaling.

    Raises:
        MissingFileError: there is no such file; the message says that ``what`` was expected.
        FileFormatError: the file is not an image, or is cut short.
    """
    path = check_file(path, what)
    encoded = np.fromfile(path, dtype=np.uint8)
    pages: Sequence[Array] = ()
    if encoded.size:
        with suppress(cv2.error):
            pages = cv2.imdecodemulti(encoded, cv2.IMREAD_UNCHANGED)[1]
    if not pages:
        raise FileFormatError(
            f"{path}: cannot be read as an image ({encoded.size} bytes); the file is damaged, cut "
            f"short, or of an unknown format. {what[:1].upper() + what[1:]} was expected: "
            f"copy or download the file again."
        )
    return [_to_rgb(np.asarray(page)) for page in pages]


def read_image(
    path: str | Path, image_size: tuple[int, int] | None = None, what: str = "an image"
) -> torch.Tensor:
    """Read an image as float32 ``(3, h, w)`` in [0, 1]; grey gets three equal channels, alpha is dropped.

    Args:
        path: any format OpenCV reads, with 8 or 16 bits a channel.
        image_size: the ``(height, width)`` that the calibration promises, checked if given.
        what: what is expected there, for the error messages.

    Raises:
        MissingFileError: there is no such file.
        FileFormatError: the file is not readable, is no 8- or 16-bit image, or has another size.
    """
    page = read_pages(path, what)[0]
    if page.dtype not in (np.uint8, np.uint16):
        raise FileFormatError(f"{path}: expected 8 or 16 bits a channel, got {page.dtype} pixels")
    height, width = page.shape[:2]
    if image_size is not None and (height, width) != tuple(image_size):
        raise FileFormatError(
            f"{path}: expected {image_size[1]} x {image_size[0]} pixels (width x height, from the "
            f"calibration), got {width} x {height}. "
            f"Use the calibration made at this size; resized images need their own."
        )
    if page.ndim == 2:
        page = np.repeat(page[..., None], 3, axis=-1)
    scaled = page.astype(np.float32) / np.float32(np.iinfo(page.dtype).max)
    return torch.from_numpy(np.ascontiguousarray(scaled.transpose(2, 0, 1)))


def write_pages(path: str | Path, pages: list[Array]) -> None:
    """Write arrays as they are (``(h, w)`` or RGB ``(h, w, 3)``); more than one page makes a multi-page TIFF.

    Raises:
        FileFormatError: the format named by the suffix cannot hold these pages.
    """
    path = Path(path)
    stored = [page[..., ::-1] if page.ndim == 3 else page for page in pages]
    stored = [np.ascontiguousarray(page) for page in stored]
    with whole_file(path) as temporary:
        try:
            if len(stored) == 1:
                ok = cv2.imwrite(str(temporary), stored[0])
            else:
                ok = cv2.imwritemulti(str(temporary), stored)
        except cv2.error as error:
            raise FileFormatError(
                f"{path}: cannot be written in the format of the suffix {path.suffix!r}: {error.err}"
            ) from error
        if not ok:
            kinds = ", ".join(f"{page.dtype} {page.shape}" for page in stored)
            raise FileFormatError(
                f"{path}: writing failed (disk full, or {path.suffix!r} cannot hold {kinds})"
            )


def write_image(path: str | Path, image: torch.Tensor | Array) -> None:
    """Write an image with 8 bits a channel.

    Args:
        path: the suffix chooses the format; folders are made.
        image: float tensor ``(3, h, w)`` or ``(1, h, w)`` in [0, 1] (values beyond are clipped), or a uint8
            array ``(h, w)`` or RGB ``(h, w, 3)``.

    Raises:
        ShapeError: the image is none of these.
    """
    if isinstance(image, torch.Tensor):
        if image.ndim != 3 or image.shape[0] not in (1, 3) or not image.is_floating_point():
            raise ShapeError(
                f"image: expected a float tensor (3, h, w) or (1, h, w), got {image.dtype} "
                f"{tuple(image.shape)}"
            )
        levels = (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu()
        image = levels.permute(1, 2, 0).numpy()
    if image.dtype != np.uint8 or image.ndim not in (2, 3):
        raise ShapeError(f"image: expected uint8 (h, w) or (h, w, 3), got {image.dtype} {image.shape}")
    write_pages(path, [image[..., 0] if image.ndim == 3 and image.shape[-1] == 1 else image])


def list_folder(folder: str | Path, what: str) -> set[str]:
    """Names of the files in a folder, from one directory scan.

    Raises:
        MissingFileError: there is no such folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise MissingFileError(f"{folder}: no such folder ({what} expected)")
    with os.scandir(folder) as entries:
        return {entry.name for entry in entries if not entry.name.startswith(".")}


def _to_rgb(page: Array) -> Array:
    """OpenCV's channel order to RGB; one-channel images lose their channel axis."""
    if page.ndim == 3 and page.shape[-1] == 1:
        return page[..., 0]
    if page.ndim == 3:
        return np.ascontiguousarray(page[..., 2::-1])
    return page
