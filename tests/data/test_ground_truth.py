# SPDX-License-Identifier: Apache-2.0
"""Both encodings of ground truth, against numbers worked out by hand and files written by OpenCV alone."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.data.omnistereo.ground_truth import read_ground_truth, write_ground_truth


def test_convention_png_value_over_65500_times_minimum_depth(tmp_path: Path) -> None:
    values = np.zeros((2, 4), np.uint16)
    values[0] = 65500, 32750, 655, 0
    cv2.imwrite(str(tmp_path / "1.png"), values)
    inverse_depth, valid = read_ground_truth(tmp_path / "1.png", min_depth=0.55)
    assert inverse_depth[0].tolist() == pytest.approx([1 / 0.55, 1 / 1.1, 1 / 55, 0.0])
    assert valid.all()
    assert inverse_depth.dtype == torch.float32


def test_convention_tiff_second_page_or_the_only_float_page(tmp_path: Path) -> None:
    numbers = np.linspace(0, 0.6, 8, dtype=np.float32).reshape(2, 4)
    numbers[0, 1:3] = np.nan, -1.0
    cv2.imwritemulti(str(tmp_path / "two.tiff"), [np.zeros((2, 4, 3), np.uint8), numbers])
    cv2.imwrite(str(tmp_path / "one.tiff"), numbers)
    for name in ("two.tiff", "one.tiff"):
        inverse_depth, valid = read_ground_truth(tmp_path / name, min_depth=99.0)  # plays no part
        assert valid.tolist() == [[True, False, False, True], [True] * 4]
        np.testing.assert_array_equal(inverse_depth[valid], numbers[valid])
        assert (inverse_depth[~valid] == 0).all()


def test_unknown_depth_fits_in_tiff_only(tmp_path: Path) -> None:
    truth, valid = torch.full((2, 4), 0.5), torch.ones(2, 4, dtype=torch.bool)
    valid[1, 2] = False
    write_ground_truth(tmp_path / "1.tiff", truth, 0.55, valid)
    assert torch.equal(read_ground_truth(tmp_path / "1.tiff", 0.55).valid, valid)
    with pytest.raises(ArgumentError, match=r"1 points of inverse_depth are unknown .* TIFF release"):
        write_ground_truth(tmp_path / "1.png", truth, 0.55, valid)


def test_points_too_near_for_png_are_clipped_with_a_warning(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"2 points are nearer than min_depth = 0.55 m"):
        write_ground_truth(
            tmp_path / "1.png", torch.tensor([[0.0, 2.0, 1.0, 3.0]] * 2)[:1].expand(1, 4), 0.55
        )
    inverse_depth, _ = read_ground_truth(tmp_path / "1.png", 0.55)
    assert inverse_depth.max().item() == pytest.approx(65535 / 65500 / 0.55)


def test_other_suffixes_and_shapes_are_refused(tmp_path: Path) -> None:
    for name, pixels, told in (
        ("1.tiff", np.zeros((2, 4, 3), np.uint8), r"expected a 16-bit PNG .*uint8 \(2, 4, 3\).*thumbnail"),
        ("1.png", np.zeros((3, 4), np.uint16), "panorama: expected width = 2 x height"),
    ):
        cv2.imwrite(str(tmp_path / name), pixels)
        with pytest.raises(FileFormatError, match=f"{name}: {told}"):
            read_ground_truth(tmp_path / name, 0.55)
