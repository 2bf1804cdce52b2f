# SPDX-License-Identifier: Apache-2.0
"""Corners of boards are where the boards were rendered, whole or in part, on pictures of lenses past 180°."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import center_of_mass

from sphericalvision.cameras import FisheyeCamera
from sphericalvision.capture import AprilGrid, Charuco, Checkerboard, read_board
from sphericalvision.core import FileFormatError
from sphericalvision.geometry import transform_from_axis_angle, transform_points
from tests.recipes.board_pictures import AnyBoard, Drawing, Eye

LENS = FisheyeCamera(
    "equisolid", torch.tensor([150.0, 151.0]).double(), [239.0, 241.0], (480, 480), math.radians(100)
)
GRID = AprilGrid(3, 2, 0.06, 0.3)
MARKERS = Charuco(6, 4, 0.05, 0.0375, "4X4_50")
TARGET = "target_type: 'aprilgrid' #gridtype\ntagCols: 3\ntagRows: 2\ntagSize: 0.08\ntagSpacing: 0.3\n"


@pytest.fixture(scope="module")
def eye() -> Eye:
    return Eye(LENS)


@pytest.mark.parametrize(
    ("board", "angle_deg", "least"),
    [
        (GRID, 0, 0.8),
        (GRID, 70, 0.6),
        (GRID, 93, 0.3),
        (MARKERS, 20, 0.9),
        (MARKERS, 93, 0.5),
        (Checkerboard(7, 5, 0.05), 40, 1.0),
        (Checkerboard(6, 4, 0.05), 93, 0.0),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, AnyBoard) else None,
)
def test_corners_are_where_they_were_rendered(
    eye: Eye, board: AnyBoard, angle_deg: float, least: float
) -> None:
    """To an eighth of a pixel, and enough of those in view; a mistaken order would be off by tens of pixels."""
    drawing = Drawing(board)
    angle = torch.tensor([0.0, math.radians(angle_deg), 0.0])
    aim = transform_from_axis_angle(angle, torch.zeros(3)).double()
    tilt = transform_from_axis_angle(torch.tensor([0.3, -0.2, 0.5]), torch.tensor([0.0, 0.0, 0.42])).double()
    pose = aim @ tilt @ drawing.facing
    truth = LENS.project(transform_points(pose, board.points))
    picture = torch.from_numpy(eye.picture(drawing, pose, noise=2.0)).movedim(-1, 0) / 255
    pixels, seen = board.find(picture)
    if not least:
        assert not seen.any()
        return
    assert seen.sum() >= least * truth.valid.sum()
    misses = (pixels - truth.pixels)[seen].norm(dim=-1)
    if isinstance(board, Checkerboard):  # which looks the same from the other side
        misses = torch.minimum(misses, (pixels - truth.pixels.flip(0)).norm(dim=-1))
    assert misses.median() < 0.125
    assert (misses < 0.5).double().mean() >= 0.8


def test_pixels_of_an_enlarged_picture_are_those_of_the_picture() -> None:
    rows, columns = np.mgrid[:40, :50]
    spot = np.exp(-((rows - 12.3) ** 2 + (columns - 30.6) ** 2) / 8)
    for picture, back in GRID._sized((255 * spot).round().astype(np.uint8)):
        row, column = center_of_mass(picture)
        assert back(np.array([column, row])) == pytest.approx([30.6, 12.3], abs=0.02)


@pytest.mark.parametrize("turns", range(4))
def test_a_tag_is_read_with_three_wrong_bits_whichever_way_it_stands(turns: int) -> None:
    """As many as are corrected: no other bit may be looked up beside its cell."""
    tag, side = 5, 20
    bits = np.zeros((10, 10), np.uint8)
    bits[2:8, 2:8] = GRID._tags.getBitsFromByteList(GRID._tags.bytesList[tag : tag + 1], 6)
    bits[[2, 4, 5], [5, 2, 7]] ^= 1
    picture = np.pad(np.kron(np.rot90(bits, turns), np.full((side, side), 255, np.uint8)), side)
    quad = side + 10 * side * np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) - 0.5
    assert GRID._decoded(picture, quad) == (tag, turns)


@pytest.mark.parametrize("board", [GRID, MARKERS, Checkerboard(7, 5, 0.05)])
def test_nothing_is_found_on_grey(board: AnyBoard) -> None:
    assert not board.find(torch.full((3, 60, 80), 0.5)).seen.any()


def test_target_files_of_kalibr_are_read(tmp_path: Path) -> None:
    """Corners count from the lower left, y is up; rows and columns of checkerboards have sides of their own."""
    path = tmp_path / "target.yaml"
    path.write_text(TARGET)
    points = read_board(path).points
    assert points.shape == (24, 3)
    assert points[[1, 2, 6, 12]].tolist() == [
        pytest.approx(place) for place in ((0.08, 0, 0), (0.104, 0, 0), (0, 0.08, 0), (0, 0.104, 0))
    ]
    sides = "rowSpacingMeters: 0.06\ncolSpacingMeters: 0.05"
    path.write_text(f"target_type: checkerboard\ntargetCols: 7\ntargetRows: 5\n{sides}\n")
    assert read_board(path).points[-1].tolist() == pytest.approx([0.3, 0.24, 0])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("'aprilgrid'", "circlegrid"), ("circlegrid", "aprilgrid or checkerboard")),
        (("tagSize: 0.08", "tagSize: 80000"), ("tagSize", "80000")),
        (("tagCols: 3", "tagCols: 3.5"), ("tagCols", "expected a count")),
        (("tagCols: 3", "tagCols: 900"), ("587 tags", "900")),
        (("tagSpacing: 0.3", ""), ("tagSpacing", "missing")),
        (("tagRows: 2", "tagRows: 2\nmirrored: true"), ("mirrored",)),
    ],
)
def test_what_is_wrong_with_a_target_file_is_named(
    tmp_path: Path, change: tuple[str, str], words: tuple[str, ...]
) -> None:
    path = tmp_path / "target.yaml"
    path.write_text(TARGET.replace(*change))
    with pytest.raises(FileFormatError) as error:
        read_board(path)
    assert all(word in str(error.value) for word in ("target.yaml", *words))
