# SPDX-License-Identifier: Apache-2.0
"""Images and masks from and to disk as tensors; files are written whole or not at all."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.core import ArgumentError, FileFormatError, ShapeError, check_choice, check_file
from sphericalvision.io.files import read_bytes, write_bytes
from sphericalvision.io.times import seconds

MAX_PIXELS = 2**27
"""Maximum of pixels of all pages of an image file; a file whose header claims more is refused undecoded."""

MAX_PAGES = 256
"""Of an image file: of a film of tiny pages each takes time, whatever its size."""

MAX_LABELS = 32
"""Different values of a mask that may be labels; a soft or noisy border has more."""

MAX_SCANS = 200
"""Of a JPEG, each of which passes over the whole image; programs write about ten."""

ORIENTATION = 0x0112
"""Tag of an image file: which way up it is to be shown."""

TIFF = (b"II*\0", b"MM\0*")
"""How TIFF files begin, of either byte order."""

SIZES_UNKNOWN = (b"II*", b"MM\0*", b"II+", b"MM\0+", b"#?")
"""How files begin whose sizes Pillow does not always know: TIFF in one of its many variants, Radiance HDR."""

Array = npt.NDArray[Any]
Size = tuple[int, int]


def read_pages(path: str | Path, what: str = "an image") -> list[Array]:
    """Read all pages of an image file as stored (colour pages as RGB), without scaling.

    An orientation in the file is ignored: calibrations are of the stored image.

    Args:
        path: any format OpenCV reads.
        what: what is expected there, for the error messages.

    Raises:
        MissingFileError: there is no such file; the message says that ``what`` was expected.
        FileFormatError: the file is not an image, is cut short, or claims more than ``MAX_PIXELS`` pixels.
    """
    return [_to_rgb(page) for page in _decoded(path, what)]


def decode_image(encoded: Array, where: str, what: str = "an image") -> Array:
    """Decode the first page of an image file in memory as stored, ``(h, w)`` or RGB ``(h, w, 3)``; checks as of files.

    Args:
        encoded: bytes of the file.
        where: it comes from, for messages.
        what: what is expected there, for messages.

    Raises:
        FileFormatError: as of ``read_pages``.
    """
    return _to_rgb(_decode(encoded, where, what)[0])


def read_image_size(path: str | Path) -> Size:
    """Return the ``(height, width)`` of an image file's first page, from its header if possible.

    Args:
        path: any format OpenCV reads.

    Raises:
        MissingFileError: there is no such file.
        FileFormatError: neither header nor pixels can be read.
    """
    from PIL import Image  # only who reads files pays for it

    path = check_file(path, "an image")
    with warnings.catch_warnings(), suppress(Exception):  # Pillow raises whatever it meets in a damaged file
        warnings.simplefilter("ignore")
        with Image.open(path) as image:
            return image.height, image.width
    height, width = read_pages(path)[0].shape[:2]
    return height, width


def read_exif_time(path: str | Path) -> float | None:
    """Time in seconds of a picture by the camera's clock, from EXIF; None if there is none."""
    from PIL import Image  # only who reads files pays for it

    with suppress(Exception), Image.open(path) as image:
        exif = image.getexif().get_ifd(0x8769)
        return seconds([f"{exif[0x9003].replace(':', '-', 2)}.{exif.get(0x9291) or '0':0<3.3}"])[0]
    return None


def read_image(
    path: str | Path, image_size: Size | None = None, what: str = "an image"
) -> Float[Tensor, "3 h w"]:
    """Read an image as float32 ``(3, h, w)`` in [0, 1]; grey gets three equal channels, alpha is dropped.

    An orientation in the file is ignored.

    Args:
        path: any format OpenCV reads, with 8 or 16 bits a channel.
        image_size: the ``(height, width)`` that the calibration promises, checked if given.
        what: what is expected there, for the error messages.

    Raises:
        MissingFileError: there is no such file.
        FileFormatError: the file is not readable, is no 8- or 16-bit image, or has another size.

    Examples:
        >>> write_image("grey.png", torch.full((1, 4, 6), 0.2))
        >>> read_image("grey.png", image_size=(4, 6)).shape  # three equal channels
        torch.Size([3, 4, 6])
    """
    page = _to_rgb(_first_page(path, image_size, what))
    if page.ndim == 2:
        page = np.repeat(page[..., None], 3, axis=-1)
    warn_of_bits(int(page.max(initial=0)), what, 8 * page.dtype.itemsize)
    scaled = page.astype(np.float32) / np.float32(np.iinfo(page.dtype).max)
    return torch.from_numpy(np.ascontiguousarray(scaled.transpose(2, 0, 1)))


def read_mask(
    path: str | Path,
    image_size: Size | None = None,
    what: str = "a mask image",
    usable: Literal["white", "black"] = "white",
) -> Bool[Tensor, "h w"]:
    """Read a mask as bool ``(h, w)``, True where images are usable: where it is, or is not, at least half white.

    White is 1, 255 or 65,535: the least of these that nothing in the file exceeds. Where an image has an alpha channel
    that is not the same everywhere, that is the mask; of other colour images the brightness counts.

    Args:
        path: any format OpenCV reads, with 8 or 16 bits a channel.
        image_size: the ``(height, width)`` of the camera's images, checked if given.
        what: what is expected there, for the error messages.
        usable: the colour of what is usable.

    Raises:
        MissingFileError: there is no such file.
        FileFormatError: the file is not readable, is no 8- or 16-bit image, has another size, leaves nothing, or is
            neither black nor white, as labels are.

    Examples:
        >>> write_pages("mask.png", [np.array([[0, 1, 1]], np.uint8)])
        >>> read_mask("mask.png"), read_mask("mask.png", usable="black")
        (tensor([[False,  True,  True]]), tensor([[ True, False, False]]))
    """
    check_choice("usable", usable, ("white", "black"))
    page = _first_page(path, image_size, what)
    is_color = page.ndim == 3
    if is_color and page.shape[-1] == 4 and page[..., 3].min() < page[..., 3].max():
        page = page[..., 3]
    elif is_color:
        page = cv2.cvtColor(_to_rgb(page), cv2.COLOR_RGB2GRAY)
    white = next(level for level in (1, 255, 65535) if page.max(initial=0) <= level)
    mask = (page > white // 2) == (usable == "white")
    if not mask.any() or 0 < page.max(initial=0) <= white // 2:
        raise FileFormatError(
            f"{path}: the mask leaves nothing of the image, or has no white; {what} has to be {usable} where images "
            "are usable"
        )
    levels, counts = np.unique(page, return_counts=True)
    labels = levels[(levels > 0) & (levels <= white // 16) & (counts > page.size / 100)]
    if not is_color and len(levels) <= MAX_LABELS and len(labels):
        raise FileFormatError(
            f"{path}: expected black and white, got labels ({', '.join(map(str, levels))}); {what} has to be {usable} "
            "where images are usable"
        )
    return torch.from_numpy(mask)


def write_pages(path: str | Path, pages: list[Array]) -> None:
    """Write arrays as they are (``(h, w)`` or RGB ``(h, w, 3)``); more than one page makes a multi-page TIFF.

    The file is encoded in memory first, so that a full disk is an error and never a shorter image.

    Raises:
        ShapeError: a page has other channels.
        FileFormatError: the format named by the suffix cannot hold these pages.
        OSError: the file cannot be written.
    """
    path = Path(path)
    for page in pages:
        if page.shape[2:] not in ((), (1,), (3,)) or page.ndim < 2:
            raise ShapeError(f"pages: expected (h, w) or RGB (h, w, 3), got {page.dtype} {page.shape}")
    stored = [np.ascontiguousarray(page[..., ::-1] if page.ndim == 3 else page) for page in pages]
    try:
        if len(stored) == 1:
            ok, encoded = cv2.imencode(path.suffix, stored[0])
        else:
            ok, encoded = cv2.imencodemulti(path.suffix, stored)
    except cv2.error as error:
        raise FileFormatError(
            f"{path}: cannot be written in the format of the suffix {path.suffix!r}: {error.err}"
        ) from error
    if not ok or not _holds(encoded, stored):
        kinds = ", ".join(f"{page.dtype} {page.shape}" for page in stored)
        raise FileFormatError(f"{path}: the format of the suffix {path.suffix!r} cannot hold {kinds}")
    write_bytes(path, encoded.tobytes())


def _holds(encoded: Array, pages: list[Array]) -> bool:
    """Whether all pages are there in their types; of what it does not know, OpenCV makes 8 bits, cut off at 255."""
    if len(pages) == 1 and pages[0].dtype in (np.uint8, bool):
        return True
    decoded = cv2.imdecodemulti(encoded, cv2.IMREAD_UNCHANGED)[1]
    return [page.dtype for page in decoded] == [page.dtype for page in pages]


def write_image(path: str | Path, image: Tensor | Array) -> None:
    """Write an image with 8 bits a channel.

    Args:
        path: the suffix chooses the format; folders are made.
        image: float tensor ``(3, h, w)`` or ``(1, h, w)`` in [0, 1] (values beyond are clipped), or a uint8
            array ``(h, w)`` or RGB ``(h, w, 3)``.

    Raises:
        ShapeError: the image is none of these.
        FileFormatError: the suffix names no format.
        OSError: the file cannot be written.

    Examples:
        >>> write_image("folder/white.png", torch.ones(3, 4, 6))
        >>> read_image("folder/white.png").min().item()
        1.0
    """
    if isinstance(image, Tensor):
        if image.ndim != 3 or image.shape[0] not in (1, 3) or not image.is_floating_point():
            raise ShapeError(
                f"image: expected a float tensor (3, h, w) or (1, h, w), got {image.dtype} "
                f"{tuple(image.shape)}"
            )
        image = as_bytes(image)
    if image.dtype != np.uint8 or image.ndim < 2 or image.shape[2:] not in ((), (1,), (3,)):
        raise ShapeError(f"image: expected uint8 (h, w) or (h, w, 3), got {image.dtype} {image.shape}")
    write_pages(path, [image[..., 0] if image.ndim == 3 and image.shape[-1] == 1 else image])


def warn_of_bits(brightest: int, what: str, bits: int) -> None:
    """Warn where an image has 10 or 12 of 16 bits, as sensors give them, or holds 0 and 1 alone: it is nearly black.

    Args:
        brightest: value of it.
        what: it is, for the message.
        bits: of its type.
    """
    held = {1: 1, 9: 10, 10: 10, 11: 12, 12: 12}.get(brightest.bit_length(), bits)
    if held < bits:
        white = 2**bits - 1
        warnings.warn(
            f"{what}: expected {bits} bits, of which {white} is white, but none is above {2**held - 1}; if that is "
            f"white, multiply them by {white // (2**held - 1)}",
            stacklevel=3,
        )


def as_bytes(image: Float[Tensor, "c h w"]) -> Array:
    """Return an image ``(c, h, w)`` in [0, 1] as uint8 ``(h, w, c)``; values beyond are clipped.

    Examples:
        >>> as_bytes(torch.tensor([[[0.5, 2.0]]])).tolist()
        [[[128], [255]]]
    """
    levels: Array = (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().movedim(0, -1).numpy()
    return levels


def write_mask(path: str | Path, mask: Bool[Tensor, "h w"]) -> None:
    """Write a mask ``(h, w)`` as an image, white where it is True.

    Raises:
        ArgumentError: the mask is of another type than bool.
        FileFormatError: the suffix names no format.
        OSError: the file cannot be written.
    """
    if mask.dtype != torch.bool:
        raise ArgumentError(f"mask: expected bool, got {mask.dtype}; mask > 0 makes one")
    write_pages(path, [mask.to("cpu", torch.uint8).numpy() * 255])


def _first_page(path: str | Path, image_size: Size | None, what: str) -> Array:
    """The first page as OpenCV has it, ``(h, w)`` or blue, green, red and maybe alpha, if it has 8 or 16 bits."""
    page = _decoded(path, what, image_size)[0]
    if page.dtype not in (np.uint8, np.uint16):
        raise FileFormatError(f"{path}: expected 8 or 16 bits a channel, got {page.dtype} pixels")
    full = np.iinfo(page.dtype).max
    if (white := _white_of_pnm(path)) and white < full:  # of which OpenCV takes no notice
        page = (page.astype(np.float64) * (full / white)).round().clip(0, full).astype(page.dtype)
    return page[..., 0] if page.ndim == 3 and page.shape[-1] == 1 else page


def _white_of_pnm(path: str | Path) -> int | None:
    """The white value in the header of a PGM or PPM, such as 1023 for 10 bits; None for other files."""
    with Path(path).open("rb") as file:
        tokens = re.sub(rb"#[^\n]*", b"", file.read(1024)).split(maxsplit=4)
    is_pnm = len(tokens) > 3 and tokens[0] in (b"P2", b"P3", b"P5", b"P6") and tokens[3].isdigit()
    return int(tokens[3]) if is_pnm else None


def _decoded(path: str | Path, what: str, image_size: Size | None = None) -> list[Array]:
    """All pages as OpenCV decodes them, after what ``read_pages`` checks."""
    path = check_file(path, what)
    return _decode(np.frombuffer(read_bytes(path, MAX_PIXELS * 16), np.uint8), path, what, image_size)


def _decode(encoded: Array, path: str | Path, what: str, image_size: Size | None = None) -> list[Array]:
    sizes, turned = _sizes(encoded)
    if turned:
        raise FileFormatError(
            f"{path}: this TIFF says that it is turned; store it as it is meant, without that tag"
        )
    _check_sizes(path, sizes, image_size)
    pages: Sequence[Array] = ()
    # OpenCV allocates gigabytes for damaged headers, so a file without a known size is not decoded.
    believed = bool(sizes) or encoded[:4].tobytes().startswith(SIZES_UNKNOWN)
    if believed and _chunks_fit(encoded):
        with suppress(cv2.error):
            pages = cv2.imdecodemulti(encoded, cv2.IMREAD_UNCHANGED)[1]
    if not pages and encoded[:4].tobytes() in TIFF:
        pages = _half_precision_pages(encoded)
    if not pages:
        raise FileFormatError(
            f"{path}: cannot be read as an image ({encoded.size} bytes); the file is damaged, cut "
            f"short, or of an unknown format. {what[:1].upper() + what[1:]} was expected: "
            f"copy or download the file again."
        )
    _check_sizes(path, [(page.shape[0], page.shape[1]) for page in pages], image_size)
    return [np.asarray(page) for page in pages]


def _half_precision_pages(encoded: Array) -> list[Array]:
    """Pages of a TIFF of 16-bit floating point numbers, which OpenCV does not read, as float32; none of other files."""
    import tifffile  # only files that need it pay for it

    # tifffile raises whatever it meets in a damaged file.
    with suppress(Exception), tifffile.TiffFile(io.BytesIO(encoded.tobytes())) as file:
        pages = list(file.pages)
        pixels = sum(int(np.prod(page.shape)) for page in pages)
        if pixels <= MAX_PIXELS and all(page.dtype == np.float16 for page in pages):
            return [page.asarray().astype(np.float32) for page in pages]
    return []


def _sizes(encoded: Array) -> tuple[list[Size], bool]:
    """(height, width) of every page by the headers, none if damaged; and whether OpenCV would turn the image.

    OpenCV turns TIFFs with an orientation, and no other format. Pixels are not decoded, so a small file that claims to
    be a huge image costs nothing.
    """
    from PIL import Image  # only who reads files pays for it

    sizes: list[Size] = []
    turned = False
    with warnings.catch_warnings(), suppress(Exception):  # Pillow raises whatever it meets in a damaged file
        warnings.simplefilter("ignore")
        try:
            with Image.open(io.BytesIO(encoded.tobytes())) as image:
                turned = image.format == "TIFF" and image.getexif().get(ORIENTATION, 1) != 1
                while (
                    sum(height * width for height, width in sizes) <= MAX_PIXELS and len(sizes) <= MAX_PAGES
                ):
                    image.seek(len(sizes))  # the first page, then one after the other until there is none
                    sizes.append((image.height, image.width))
        except Image.DecompressionBombError:  # whose own bound is a little higher
            sizes.append((MAX_PIXELS, MAX_PIXELS))
    return sizes, turned


def _chunks_fit(encoded: Array) -> bool:
    """Whether all chunks of a PNG end within the file, and a JPEG has no more than ``MAX_SCANS``; True for others."""
    content, at = memoryview(encoded.tobytes()), 8
    if content[:2] == b"\xff\xd8":
        return encoded.tobytes().count(b"\xff\xda") <= MAX_SCANS
    if content[:8] != b"\x89PNG\r\n\x1a\n":
        return True
    while at + 12 <= len(content) and content[at + 4 : at + 8] != b"IEND":
        at += 12 + int.from_bytes(content[at : at + 4], "big")
    return at + 12 <= len(content)


def _check_sizes(path: str | Path, sizes: list[Size], image_size: Size | None) -> None:
    if image_size is not None and sizes and sizes[0] != tuple(image_size):
        raise FileFormatError(
            f"{path}: expected {image_size[1]} x {image_size[0]} pixels (width x height, from the "
            f"calibration), got {sizes[0][1]} x {sizes[0][0]}. "
            f"Use the calibration made at this size; resized images need their own."
        )
    if sum(height * width for height, width in sizes) > MAX_PIXELS:
        raise FileFormatError(
            f"{path}: expected an image of at most {MAX_PIXELS} pixels on all of its pages together, got more"
        )
    if len(sizes) > MAX_PAGES:
        raise FileFormatError(f"{path}: expected an image of at most {MAX_PAGES} pages, got more")


def _to_rgb(page: Array) -> Array:
    """OpenCV's channel order to RGB; one-channel images lose their channel axis."""
    if page.ndim == 3 and page.shape[-1] == 1:
        return page[..., 0]
    if page.ndim == 3:
        return np.ascontiguousarray(page[..., 2::-1])
    return page
