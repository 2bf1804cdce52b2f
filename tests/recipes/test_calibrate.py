# SPDX-License-Identifier: Apache-2.0
"""A camera from rendered pictures of a checkerboard, whose truth is known, from the command line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from sphericalvision.cameras import KannalaBrandtCamera, read_camera
from sphericalvision.geometry import transform_points
from sphericalvision.io.images import write_image
from sphericalvision.recipes.commands.calibrate import board_corners, find_corners
from tests.recipes.board_pictures import COLUMNS, ROWS, SQUARE, TRUTH, boards, picture, write_boards
from tests.recipes.tiny import Run


def test_corners_are_where_the_board_was_rendered() -> None:
    pose = boards()[1]
    image = picture(TRUTH, pose).movedim(-1, 0) / 255
    found = find_corners(image, COLUMNS, ROWS)
    expected = TRUTH.project(transform_points(pose, board_corners(COLUMNS, ROWS, SQUARE)).float()).pixels
    assert found is not None
    error = torch.minimum(
        (found - expected).norm(dim=-1).max(), (found.flip(0) - expected).norm(dim=-1).max()
    )
    assert error < 0.3
    assert find_corners(torch.full((3, 60, 80), 0.5), COLUMNS, ROWS) is None


def test_a_lens_is_calibrated_from_pictures(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_boards(tmp_path / "board")
    run(
        "calibrate", "images=board/*.png", f"board={COLUMNS}x{ROWS}", f"square={SQUARE}",
        "num_coefficients=2", "field_of_view_deg=130", "output=lens.yaml",
    )  # fmt: skip
    assert "RMS" in capsys.readouterr().out
    camera = read_camera(tmp_path / "lens.yaml")
    assert isinstance(camera, KannalaBrandtCamera)
    pixels = TRUTH.pixel_grid()[40:200:20, 60:260:20].reshape(-1, 2)
    rays = TRUTH.unproject(pixels).directions
    assert (camera.project(rays).pixels - pixels).norm(dim=-1).max() < 0.6


def test_mistakes_are_named(failing: Callable[..., str], tmp_path: Path) -> None:
    words = ("square=0.03", "images=nothing/*.png")
    assert "nothing/*.png" in failing("calibrate", "board=9x6", *words)
    assert "such as 9x6" in failing("calibrate", "board=nine", *words)
    write_image(tmp_path / "grey.png", torch.full((60, 80, 3), 128, dtype=torch.uint8).numpy())
    assert "no_model" in failing("calibrate", "board=9x6", "to=no_model", *words)
    message = failing("calibrate", "board=9x6", "square=0.03", f"images={tmp_path}/grey.png")
    assert "found on 0 of 1 pictures" in message
