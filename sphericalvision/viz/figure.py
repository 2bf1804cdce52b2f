# SPDX-License-Identifier: Apache-2.0
"""Pictures with titles and scale bars, and several pictures on one sheet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np

from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.viz.color import Picture, colorize, fade

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BORDER = 10  # pixels left around a trimmed figure
_LEAST_WIDTH = 640  # titles and ticks fit; narrower pictures are enlarged by a whole factor


def add_scale_bar(
    picture: Picture,
    color_map: str,
    ticks: Sequence[tuple[float, str]],
    label: str,
    faded: bool = False,
) -> Picture:
    """Put a colour bar below a picture; ``sheet`` puts a title above it.

    Args:
        picture: uint8 ``(h, w, 3)``; narrow ones are enlarged by a whole factor, without smoothing.
        color_map: name of a colour map; see ``colorize``.
        ticks: position in [0, 1] along the colour map, and text.
        label: quantity and unit.
        faded: whether the colours of the bar fade to grey downwards, as those of ``fade`` do.
    """
    _check_picture(picture)
    factor = max(1, -(-_LEAST_WIDTH // picture.shape[1]))
    picture = picture.repeat(factor, axis=0).repeat(factor, axis=1)
    return np.concatenate((picture, _bar(picture.shape[1], color_map, tuple(ticks), label, faded)))


@lru_cache(maxsize=16)  # frames of a video share theirs, which takes longer to draw than a panorama
def _bar(
    width: int, color_map: str, ticks: tuple[tuple[float, str], ...], label: str, faded: bool
) -> Picture:
    left, right = round(0.03 * width), round(0.97 * width)
    bar = np.full((64, width, 3), 255, np.uint8)
    colors = colorize(np.linspace(0, 1, right - left), color_map)[None].repeat(14, axis=0)
    if faded:
        colors = fade(colors, np.linspace(1, 0, 14)[:, None].repeat(right - left, axis=1))
    bar[4:18, left:right] = colors
    for position, text in ticks:
        column = left + round(position * (right - left - 1))
        bar[18:22, column] = 0
        _write(bar, text.replace("∞", "inf"), column, 38)
    _write(bar, label, width // 2, 59)
    return bar


def _write(picture: Picture, text: str, middle: int, bottom: int) -> None:
    """Put small black text centred about a column."""
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.6
    extent = cv2.getTextSize(text, font, scale, 1)[0][0]
    cv2.putText(picture, text, (middle - extent // 2, bottom), font, scale, (0, 0, 0), 1, cv2.LINE_AA)


def sheet(pictures: Mapping[str, Picture] | Sequence[Picture], columns: int = 1, gap: int = 12) -> Picture:
    """Lay out pictures on a white sheet, row by row, each below its title and in the middle of its cell.

    Args:
        pictures: title -> uint8 ``(h, w, 3)``, or such pictures without titles.
        columns: pictures side by side.
        gap: pixels between them.

    Examples:
        >>> black, white = np.zeros((20, 300, 3), np.uint8), np.full((30, 400, 3), 255, np.uint8)
        >>> sheet({"left": black, "right": white}, columns=2).shape
        (78, 736, 3)
    """
    if not pictures or columns < 1:
        raise ArgumentError(
            f"sheet: expected pictures and at least one column, got {len(pictures)} pictures, {columns} "
            "columns"
        )
    titled = pictures.items() if isinstance(pictures, Mapping) else [("", picture) for picture in pictures]
    cells = []
    for title, picture in titled:
        _check_picture(picture)
        cells.append(np.concatenate((_text_row(title, picture.shape[1]), picture)) if title else picture)
    rows = [cells[start : start + columns] for start in range(0, len(cells), columns)]
    widths = [max(row[k].shape[1] for row in rows if k < len(row)) for k in range(min(columns, len(cells)))]
    heights = [max(cell.shape[0] for cell in row) for row in rows]
    page_size = (sum(heights) + gap * (len(rows) + 1), sum(widths) + gap * (len(widths) + 1), 3)
    page = np.full(page_size, 255, np.uint8)
    top = gap
    for row, height in zip(rows, heights, strict=True):
        column = gap
        for cell, width in zip(row, widths, strict=False):
            start = column + (width - cell.shape[1]) // 2
            page[top : top + cell.shape[0], start : start + cell.shape[1]] = cell
            column += width + gap
        top += height + gap
    return page


def strip(pictures: Sequence[Picture], width: int, gap: int = 12, most: int = 6) -> Picture:
    """Lay out pictures in rows of one width, rescaled so that they fill it.

    Args:
        pictures: uint8 ``(h, w, 3)``; those of a row become equally high.
        width: of the strip in pixels.
        gap: pixels between them.
        most: pictures in a row.

    Examples:
        >>> strip([np.zeros((30, 40, 3), np.uint8)] * 5, width=648).shape
        (90, 648, 3)
    """
    if not pictures:
        raise ArgumentError("strip: expected pictures, got none")
    number = -(-len(pictures) // most)
    rows = []
    for chosen in np.array_split(np.arange(len(pictures)), number):
        row = [pictures[place] for place in chosen]
        room = width - gap * (len(row) - 1)
        height = max(1, round(room / sum(picture.shape[1] / picture.shape[0] for picture in row)))
        ends = np.cumsum([picture.shape[1] / picture.shape[0] for picture in row])
        edges = [0, *(round(room * end / ends[-1]) for end in ends)]
        cells = []
        for picture, left, right in zip(row, edges, edges[1:], strict=False):
            _check_picture(picture)
            smaller = height * (right - left) < picture.shape[0] * picture.shape[1]
            way = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
            cells += [cv2.resize(picture, (right - left, height), interpolation=way)]
            cells += [np.full((height, gap, 3), 255, np.uint8)]
        rows += [np.concatenate(cells[:-1], 1), np.full((gap, width, 3), 255, np.uint8)]
    return np.concatenate(rows[:-1]).astype(np.uint8)


def figure_pixels(figure: Figure) -> Picture:
    """The figure as uint8 (h, w, 3), without most of its empty border."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = np.asarray(canvas.buffer_rgba())[..., :3]
    rows, columns = ((picture != 255).any(axis=(axis, 2)).nonzero()[0] for axis in (1, 0))
    top, left = max(rows[0] - _BORDER, 0), max(columns[0] - _BORDER, 0)
    return np.ascontiguousarray(picture[top : rows[-1] + _BORDER, left : columns[-1] + _BORDER])


def _text_row(text: str, width: int) -> Picture:
    """One line of black text on white, ``width`` pixels wide and 24 high; long text gets smaller."""
    font, thickness, scale = cv2.FONT_HERSHEY_SIMPLEX, 1, 0.6
    text = text.encode("ascii", "replace").decode()
    extent = cv2.getTextSize(text, font, scale, thickness)[0][0]
    scale *= min(1.0, (width - 8) / max(extent, 1))
    row = np.full((24, width, 3), 255, np.uint8)
    return cv2.putText(row, text, (4, 17), font, scale, (0, 0, 0), thickness, cv2.LINE_AA).astype(np.uint8)


def _check_picture(picture: Picture) -> None:
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[-1] != 3:
        raise ShapeError(f"picture: expected uint8 (h, w, 3), got {picture.dtype} {picture.shape}")
