# SPDX-License-Identifier: Apache-2.0
"""Images survive the disk, failures say what is wrong, and half-written files never appear."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sphericalvision.core import FileFormatError, MissingFileError, ShapeError
from sphericalvision.io.images import (
    list_folder,
    read_image,
    read_pages,
    whole_file,
    write_image,
    write_pages,
)


def test_eight_bit_colours_come_back_and_channels_are_red_green_blue(tmp_path: Path) -> None:
    image = torch.randint(0, 256, (3, 5, 7), generator=torch.Generator().manual_seed(0)) / 255
    write_image(tmp_path / "a.png", image)
    torch.testing.assert_close(read_image(tmp_path / "a.png"), image, rtol=0, atol=1e-7)
    blue_green_red = cv2.imread(str(tmp_path / "a.png"))
    np.testing.assert_allclose(blue_green_red[..., ::-1].transpose(2, 0, 1) / 255, image, atol=1e-6)


def test_grey_and_sixteen_bit_and_alpha(tmp_path: Path) -> None:
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4)
    cv2.imwrite(str(tmp_path / "grey.png"), grey)
    image = read_image(tmp_path / "grey.png")
    assert image.shape == (3, 3, 4)
    np.testing.assert_allclose(image, np.stack([grey] * 3) / 255, atol=1e-7)
    cv2.imwrite(str(tmp_path / "deep.png"), np.full((2, 2), 65535, np.uint16))
    assert (read_image(tmp_path / "deep.png") == 1).all()
    four = np.dstack(
        [np.full((2, 3), level, np.uint8) for level in (10, 20, 30, 255)]
    )  # blue, green, red, alpha
    cv2.imwrite(str(tmp_path / "four.png"), four)
    assert (read_image(tmp_path / "four.png")[:, 0, 0] * 255).tolist() == pytest.approx([30, 20, 10])


def test_writing_clips_and_rounds(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", torch.tensor([[[-1.0, 0.4999 / 255, 0.5001 / 255, 7.0]]]))
    assert read_pages(tmp_path / "a.png")[0].tolist() == [[0, 0, 1, 255]]


def test_pages_of_a_tiff_keep_type_and_values(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    color, numbers = rng.integers(0, 256, (4, 8, 3), np.uint8), rng.random((4, 8), np.float32)
    write_pages(tmp_path / "two.tiff", [color, numbers])
    first, second = read_pages(tmp_path / "two.tiff")
    np.testing.assert_array_equal(first, color)
    np.testing.assert_array_equal(second, numbers)
    assert second.dtype == np.float32


def test_errors_name_file_cause_and_remedy(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"nowhere\.png.*frame 3 of cam2 expected"):
        read_image(tmp_path / "nowhere.png", what="frame 3 of cam2")
    write_image(tmp_path / "small.png", torch.zeros(3, 4, 6))
    with pytest.raises(FileFormatError, match=r"small\.png: expected 768 x 800 .* got 6 x 4"):
        read_image(tmp_path / "small.png", image_size=(800, 768))
    for name, content in {"empty.png": b"", "text.png": b"not an image at all"}.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FileFormatError, match=f"{name}.*cannot be read.*download"):
            read_image(tmp_path / name)
    cv2.imwrite(str(tmp_path / "float.tiff"), np.zeros((2, 2), np.float32))
    with pytest.raises(FileFormatError, match="8 or 16 bits"):
        read_image(tmp_path / "float.tiff")
    with pytest.raises(MissingFileError, match=r"none: no such folder \(images expected\)"):
        list_folder(tmp_path / "none", "images")
    with pytest.raises(ShapeError, match=r"expected a float tensor \(3, h, w\)"):
        write_image(tmp_path / "a.png", torch.zeros(4, 6))
    with pytest.raises(FileFormatError, match=r"a\.nonsense"):
        write_image(tmp_path / "a.nonsense", torch.zeros(1, 4, 6))


def test_a_cut_off_file_is_refused(tmp_path: Path) -> None:
    noise = torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(0))
    write_image(tmp_path / "whole.png", noise)
    content = (tmp_path / "whole.png").read_bytes()
    (tmp_path / "cut.png").write_bytes(content[: len(content) // 2])
    with pytest.raises(FileFormatError, match=r"cut\.png"):
        read_image(tmp_path / "cut.png")


def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")

    def interrupted() -> None:
        with whole_file(target) as temporary:
            temporary.write_text("half of the n")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert target.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["a.txt"]
