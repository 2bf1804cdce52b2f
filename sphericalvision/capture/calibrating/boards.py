# SPDX-License-Identifier: Apache-2.0
"""Boards for calibration: where their corners are in metres, and where an image shows them.

Convention:
    A board's frame has z = 0, x right and y down as the board is read; AprilGrids have y up, as Kalibr defines them.

References:
    S. Garrido-Jurado et al., "Automatic generation and detection of highly reliable fiducial markers under occlusion",
    Pattern Recognition 47 (2014); E. Olson, "AprilTag: A robust and flexible visual fiducial system", ICRA (2011);
    https://github.com/ethz-asl/kalibr/wiki/calibration-targets
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras.calibration.keys import check_understood
from sphericalvision.cameras.calibration.text_files import load_keys
from sphericalvision.core import ArgumentError, FileFormatError, check_choice, check_file, short_repr

Array = npt.NDArray[Any]
DICTIONARIES = tuple(sorted({key[5:].upper() for key in vars(cv2.aruco) if re.match(r"DICT_(\dX|AR)", key)}))
"""Families of markers, without ``DICT_``."""
_WINDOWS = 2, 11
"""Pixels from a corner to the edge of the window in which it is refined, at least and at most."""
_ROUGH = 3
"""The same at first: quads of tags lie up to two pixels inside of these."""
_SMALL = 4_000_000
"""Pixels of an image that is also searched at twice its size, for markers with less than three pixels a bit."""
_THRESHOLDS = 31, 121
"""Pixels of the squares in which a dark pixel is darker than the mean."""
_LARGEST = 9999
_MOST = 40_000
"""Number of a target file; more is taken for a damaged one."""


class Corners(NamedTuple):
    """Where an image shows the corners of a board."""

    pixels: Float[Tensor, "m 2"]
    """(u, v), float64; 0 where not seen."""
    seen: Bool[Tensor, " m"]
    """Which were found."""


class Board(ABC):
    """A plane with corners that can be told apart.

    Attributes:
        points: of the corners, metres.
        clear: metres around a corner in which there is nothing but that corner.
    """

    points: Float[Tensor, "m 3"]
    clear: float

    def find(self, image: Float[Tensor, "3 h w"]) -> Corners:
        """The corners that an image in [0, 1] shows, refined to a fraction of a pixel."""
        grey = _grey(image)
        ids, rough = self._detected(grey)
        pixels, seen = torch.zeros(len(self.points), 2).double(), torch.zeros(len(self.points)).bool()
        if len(ids) > 1:
            fine, good = self._refined(grey, ids, rough)
            pixels[ids[good]] = torch.from_numpy(fine[good])
            seen[ids[good]] = True
        return Corners(pixels, seen)

    def remedy(self, image: Float[Tensor, "3 h w"]) -> str:
        """What to try if images such as this one do not show the board."""
        return (
            "for squares board= counts the corners between them, not the squares; leave a white border around "
            "the board"
        )

    def _sized(self, grey: Array) -> Iterator[tuple[Array, Callable[[Array], Array]]]:
        """The image and, if it is small, a larger one, with the function that takes pixels (*, 2) of it back."""
        yield grey, lambda pixels: pixels
        if grey.size <= _SMALL:
            larger = cv2.resize(grey, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
            yield larger, lambda pixels: (pixels + 0.5) / 2 - 0.5

    @abstractmethod
    def _detected(self, grey: Array) -> tuple[Array, Array]:
        """Numbers (k,) of corners and their pixels (k, 2) to a pixel or so."""

    def _refined(self, grey: Array, ids: Array, rough: Array) -> tuple[Array, Array]:
        """Pixels (k, 2) at saddles of the image, and which did find one: a window holds one corner alone."""
        points = self.points[ids]
        positions = torch.from_numpy(rough).double()
        apart, metres = torch.cdist(positions, positions), torch.cdist(points, points)
        metres.fill_diagonal_(torch.inf)
        neighbors = metres < 1.5 * metres.min(-1, keepdim=True).values
        # Pixels a metre, foreshortened
        scale = (apart / metres).masked_fill(~neighbors, torch.inf).amin(-1).numpy()
        windows = np.clip(0.5 * self.clear * scale, *_WINDOWS).astype(int)
        ending = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
        fine = np.array(rough, np.float32)
        for corner, last in zip(fine, windows.tolist(), strict=True):
            for window in {max(last, _ROUGH): 0, last: 0}:
                start = corner.reshape(1, 1, 2).copy()
                corner[:] = cv2.cornerSubPix(grey, start, (window, window), (-1, -1), ending).reshape(2)
        margin = windows[:, None]
        inside = (fine > margin) & (fine < np.array(grey.shape[::-1]) - 1 - margin)
        close = np.linalg.norm(fine - rough, axis=-1) <= np.maximum(windows, _ROUGH)
        return fine.astype(np.float64), inside.all(-1) & close


class Checkerboard(Board):
    """Black and white squares; found where an image shows all of them.

    Args:
        columns: inner corners in a row.
        rows: of inner corners.
        square: side of a square in metres, or (along a row, across rows).

    Raises:
        ArgumentError: there are fewer than three corners in a row or column.

    Examples:
        >>> Checkerboard(3, 3, 0.5).points[:4].tolist()
        [[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.5, 0.0]]
    """

    def __init__(self, columns: int, rows: int, square: float | tuple[float, float]) -> None:
        if min(columns, rows) < 3:
            raise ArgumentError(f"columns, rows: expected 3 inner corners or more, got {columns} x {rows}")
        side = torch.tensor(square).double().expand(2)
        self.columns, self.rows, self.square = columns, rows, float(side[0])
        self.points = _grid(columns, rows) * torch.cat((side, side.new_zeros(1)))
        self.clear = 0.7 * float(side.min())

    def _detected(self, grey: Array) -> tuple[Array, Array]:
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        success, corners = cv2.findChessboardCorners(grey, (self.columns, self.rows), flags=flags)
        ids = np.arange(len(self.points) if success else 0)
        return ids, corners.reshape(-1, 2) if success else np.zeros((0, 2))


class Charuco(Board):
    """A checkerboard with a marker in each white square, of which any part is enough.

    Args:
        columns: inner corners in a row: one less than squares.
        rows: of inner corners.
        square: side of a square, metres.
        marker: side of a marker, metres.
        dictionary: of ``DICTIONARIES``, as OpenCV calls them without ``DICT_``.

    Raises:
        ArgumentError: markers are not smaller than squares, there are too many, or an unknown dictionary.

    Examples:
        >>> Charuco(9, 6, 0.03, 0.022, "5X5_100").points.shape
        torch.Size([54, 3])
    """

    def __init__(
        self, columns: int, rows: int, square: float, marker: float, dictionary: str = "4X4_50"
    ) -> None:
        check_choice("dictionary", dictionary, DICTIONARIES)
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))
        if not 0 < marker < square:
            raise ArgumentError(f"marker: expected metres below {square}, the square's side, got {marker}")
        needed = (columns + 1) * (rows + 1) // 2
        if needed > len(markers.bytesList):
            raise ArgumentError(
                f"dictionary: {dictionary} has {len(markers.bytesList)} markers, for {needed} white squares"
            )
        self.square, self.dictionary, self.num_markers = square, dictionary, needed
        self.points = _grid(columns, rows) * square
        self.clear = (square - marker) / 2
        self.board = cv2.aruco.CharucoBoard((columns + 1, rows + 1), square, marker, markers)
        self._detector = cv2.aruco.CharucoDetector(self.board)

    def _detected(self, grey: Array) -> tuple[Array, Array]:
        corner_by_id: dict[int, Array] = {}
        for image, back in self._sized(grey):
            corners, ids, *_ = self._detector.detectBoard(image)
            for corner, place in () if ids is None else zip(corners, ids.ravel(), strict=True):
                corner_by_id.setdefault(int(place), back(corner.reshape(2)))
        return np.array(list(corner_by_id), int), np.array(list(corner_by_id.values())).reshape(-1, 2)

    def remedy(self, image: Float[Tensor, "3 h w"]) -> str:
        """The number of markers of the dictionary that an image shows, and the dictionary that it shows more of."""
        grey = _grey(image)
        counts = {}
        for name in (self.dictionary, *DICTIONARIES):
            markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
            ids = cv2.aruco.ArucoDetector(markers).detectMarkers(grey)[1]
            counts[name] = 0 if ids is None else len(ids)
        best = max(counts, key=lambda name: counts[name])  # the first of equals, which is the own one
        seen = f"the last shows {counts[self.dictionary]} of {self.num_markers} markers of dictionary={self.dictionary}"
        if best != self.dictionary:
            return f"{seen}, and {counts[best]} of dictionary={best}"
        return (
            f"{seen}; if it shows the whole board, correct board=, which counts the corners between squares"
        )


class AprilGrid(Board):
    """Kalibr's grid of tags 36h11 with a border of two bits, and black squares between their corners.

    As these squares touch the tags, OpenCV's own search for quads finds few of them; here dark shapes are eroded first.
    Tags count from the lower left, row by row upwards, and so do the corners: two in a row for each tag.

    Args:
        columns: of tags.
        rows: of tags.
        tag: side of a tag with its black border, metres.
        spacing: between tags, as a share of ``tag``.

    Raises:
        ArgumentError: there are more tags than the family has.

    Examples:
        >>> AprilGrid(2, 1, 0.1, 0.5).points[:4].round(decimals=3).tolist()
        [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.15, 0.0, 0.0], [0.25, 0.0, 0.0]]
    """

    def __init__(self, columns: int, rows: int, tag: float, spacing: float) -> None:
        tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        if columns * rows > len(tags.bytesList):
            raise ArgumentError(
                f"columns, rows: expected {len(tags.bytesList)} tags at most, got {columns} x {rows}"
            )
        cells = _grid(2 * columns, 2 * rows)
        self.points = ((cells / 2).floor() * (1 + spacing) + cells % 2) * tag
        self.columns, self.rows, self.tag, self.spacing = columns, rows, tag, spacing
        self.clear = min(spacing, 0.2) * tag  # a border is two of ten bits
        self._tags = tags

    def _detected(self, grey: Array) -> tuple[Array, Array]:
        quads: dict[int, Array] = {}
        for image, back in self._sized(grey):
            for window in _THRESHOLDS:
                for quad in _dark_quads(image, window):
                    tag, turns = self._decoded(image, quad)
                    if 0 <= tag < self.columns * self.rows:
                        quads[tag] = back(np.roll(quad, turns, axis=0))
        # OpenCV's tags stand on their heads beside Kalibr's: its first corner, top left, is the lower right one here.
        width = 2 * self.columns
        around = np.array([1, 0, width, width + 1])
        first = [2 * width * (tag // self.columns) + 2 * (tag % self.columns) for tag in quads]
        ids = np.array([start + around for start in first], int).reshape(-1)
        return ids, np.array(list(quads.values())).reshape(-1, 2)

    def _decoded(self, image: Array, quad: Array) -> tuple[int, int]:
        """Number of the tag in a quad (4, 2), -1 if there is none, and by how many corners it is turned."""
        side = 8  # pixels that a bit is resampled to, of which the middle half is looked at
        flat = np.array([[0, 0], [10, 0], [10, 10], [0, 10]], np.float32) * side - 0.5
        straight = cv2.getPerspectiveTransform(quad.astype(np.float32), flat)
        warped = cv2.warpPerspective(image, straight, (10 * side, 10 * side))
        black_white = cv2.threshold(warped, 0, 255, cv2.THRESH_OTSU)[1].reshape(10, side, 10, side)
        bits = (black_white[:, 2:6, :, 2:6].mean((1, 3)) > 127).astype(np.uint8)
        inner = np.ascontiguousarray(bits[2:8, 2:8])
        if bits.sum() - inner.sum() > 8:  # of the 64 bits of its border, which are black
            return -1, 0
        success, tag, turns = self._tags.identify(inner, 0.6)
        return (int(tag), int(turns)) if success else (-1, 0)


def _grey(image: Float[Tensor, "3 h w"]) -> Array:
    return (image.mean(0) * 255).round().to(torch.uint8).cpu().numpy()


def _dark_quads(image: Array, window: int) -> Iterator[Array]:
    """Corners (4, 2), clockwise, of dark shapes with four; the squares that touch their corners are cut off."""
    dark = cv2.adaptiveThreshold(image, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, window, 5)
    dark = cv2.erode(dark, np.ones((3, 3), np.uint8))
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(dark, connectivity=4)
    for label, (left, top, width, height, _) in enumerate(boxes.tolist()):
        if label == 0 or min(width, height) < 16 or max(width, height) > max(image.shape) / 2:
            continue
        alone = (labels[top : top + height, left : left + width] == label).astype(np.uint8)
        shapes, _ = cv2.findContours(alone, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        hull = cv2.convexHull(max(shapes, key=cv2.contourArea))
        length = cv2.arcLength(hull, True)
        quads = (cv2.approxPolyDP(hull, share * length, True) for share in (0.02, 0.03, 0.04, 0.06, 0.08))
        quad = next((candidate.reshape(4, 2) for candidate in quads if len(candidate) == 4), None)
        if quad is not None:
            outwards = quad - quad.mean(0)
            yield quad + (left, top) + 2**0.5 * outwards / np.linalg.norm(outwards, axis=-1, keepdims=True)


def read_board(path: str | Path) -> Board:
    """The board that a target file of Kalibr describes: ``aprilgrid`` or ``checkerboard``.

    Raises:
        FileFormatError: it cannot be parsed, lacks a key, or is of another type, such as ``circlegrid``.
        MissingFileError: there is no such file.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "target.yaml"
        >>> keys = "target_type: checkerboard", "targetCols: 9", "targetRows: 6"
        >>> _ = path.write_text("\\n".join((*keys, "rowSpacingMeters: 0.03", "colSpacingMeters: 0.03")))
        >>> read_board(path).points.shape
        torch.Size([54, 3])
    """
    path = check_file(path, "a target file of Kalibr")
    content = load_keys(path, "target_type and the keys of a target of Kalibr")

    def positive(key: str) -> float:
        if not 0 < (value := content.number(key)) < _LARGEST:
            raise FileFormatError(f"{content.at(key)}: expected a number above 0, got {value:g}")
        return value

    kind = content.get("target_type")
    try:
        if kind == "aprilgrid":
            tags = content.count("tagCols", _LARGEST), content.count("tagRows", _LARGEST)
            board: Board = AprilGrid(*tags, positive("tagSize"), positive("tagSpacing"))
        elif kind == "checkerboard":
            counts = content.count("targetCols", _LARGEST), content.count("targetRows", _LARGEST)
            board = Checkerboard(*counts, (positive("colSpacingMeters"), positive("rowSpacingMeters")))
        else:
            raise FileFormatError(
                f"{path}, target_type: expected aprilgrid or checkerboard, got {kind!r}"
                + "; middles of circles are not where lenses show them" * (kind == "circlegrid")
            )
    except ArgumentError as error:
        raise FileFormatError(f"{path}: {error}") from None
    check_understood(content, str(path), "")
    return board


def _grid(columns: int, rows: int) -> Tensor:
    """Whole numbers (columns · rows, 3) of a grid, row by row: (column, row, 0)."""
    if columns * rows > _MOST:
        raise ArgumentError(
            f"columns, rows: expected {_MOST:,} corners at most, got {short_repr(columns)} x {short_repr(rows)}"
        )
    v, u = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    return torch.stack((u, v, torch.zeros_like(u)), -1).reshape(-1, 3).double()
