# SPDX-License-Identifier: Apache-2.0
"""Images and masks survive the disk, failures say what is wrong, and no file makes the memory burst."""

import resource
import struct
import warnings
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from sphericalvision.cameras import ring_rig
from sphericalvision.core import FileFormatError, MissingFileError
from sphericalvision.io.images import (
    read_image,
    read_image_size,
    read_mask,
    read_pages,
    write_image,
    write_mask,
    write_pages,
)
from sphericalvision.sphere.intake import as_photographs


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
    # Blue, green, red, alpha
    four = np.dstack([np.full((2, 3), level, np.uint8) for level in (10, 20, 30, 255)])
    cv2.imwrite(str(tmp_path / "four.png"), four)
    assert (read_image(tmp_path / "four.png")[:, 0, 0] * 255).tolist() == pytest.approx([30, 20, 10])


@pytest.mark.parametrize("white", [100, 255, 1023, 4095, 65535])
def test_white_is_what_a_file_says(tmp_path: Path, white: int) -> None:
    """Sensors of 10 or 12 bits write portable grey maps with white at 1023 or 4095."""
    path, kind = tmp_path / "grey.pgm", ">u2" if white > 255 else "u1"
    values = np.array([[0, white // 2, white]]).astype(kind)
    path.write_bytes(b"P5\n# of a sensor\n3 1\n%d\n" % white + values.tobytes())
    expected = torch.tensor([0.0, white // 2 / white, 1.0])
    torch.testing.assert_close(read_image(path)[1, 0], expected, atol=0.5 / 255, rtol=0)
    assert read_mask(path)[0, ::2].tolist() == [False, True]


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


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", ["f2", "f4", "u2"])
def test_tiffs_of_both_byte_orders_and_of_half_precision_are_read(
    tmp_path: Path, order: str, kind: str
) -> None:
    tifffile = pytest.importorskip("tifffile")
    values = np.array([[1, 2, 1024], [0, 3, 5]], kind)
    tifffile.imwrite(tmp_path / "depth.tiff", values.astype(order + kind), byteorder=order)
    (page,) = read_pages(tmp_path / "depth.tiff")
    assert page.dtype == (np.uint16 if kind == "u2" else np.float32)
    assert np.array_equal(page, values)


def test_errors_name_file_cause_and_remedy(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"nowhere\.png.*frame 3 of cam2 expected"):
        read_image(tmp_path / "nowhere.png", what="frame 3 of cam2")
    write_image(tmp_path / "noise.png", torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(0)))
    whole = (tmp_path / "noise.png").read_bytes()
    for name, content in {
        "empty.png": b"",
        "text.png": b"not an image at all",
        "cut.png": whole[: len(whole) // 2],
        "no_size.tiff": b"II*\x00\x08" + bytes(9),  # of which Pillow raises TypeError
    }.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FileFormatError, match=f"{name}.*cannot be read.*download"):
            read_image(tmp_path / name)
    cv2.imwrite(str(tmp_path / "float.tiff"), np.zeros((2, 2), np.float32))
    with pytest.raises(FileFormatError, match="8 or 16 bits"):
        read_image(tmp_path / "float.tiff")


@pytest.mark.parametrize(
    ("name", "kind", "count"),
    [("a.jpg", np.uint16, 1), ("a.png", np.float32, 1), ("a.tiff", np.float16, 1), ("a.png", np.uint8, 2)],
)
def test_formats_that_cannot_hold_pages_are_refused(
    tmp_path: Path, name: str, kind: type[np.generic], count: int
) -> None:
    with pytest.raises(FileFormatError, match=rf"{name}: the format .* cannot hold {kind.__name__} \(4, 6\)"):
        write_pages(tmp_path / name, [np.ones((4, 6), kind)] * count)
    assert not (tmp_path / name).exists()


def test_orientation_is_ignored(tmp_path: Path) -> None:
    """As of videos: a calibration is of what the sensor stores."""
    stored = np.zeros((4, 6, 3), np.uint8)
    stored[0] = 255
    exif = Image.Exif()
    exif[0x0112] = 6  # a quarter turn
    for suffix in ("png", "jpg"):
        Image.fromarray(stored).save(tmp_path / f"a.{suffix}", exif=exif)
        image = read_image(tmp_path / f"a.{suffix}")
        assert image.shape == (3, 4, 6)
        assert image[:, 0].min() > 0.8
        assert read_image_size(tmp_path / f"a.{suffix}") == (4, 6)
    Image.fromarray(stored).save(tmp_path / "a.tiff", exif=exif)
    with pytest.raises(FileFormatError, match=r"a\.tiff: this TIFF says that it is turned"):
        read_image(tmp_path / "a.tiff")


def test_masks_come_back_and_are_true_from_half_white(tmp_path: Path) -> None:
    mask = torch.rand(5, 7, generator=torch.Generator().manual_seed(0)) > 0.5
    write_mask(tmp_path / "mask.png", mask)
    assert torch.equal(read_mask(tmp_path / "mask.png", (5, 7)), mask)
    cv2.imwrite(str(tmp_path / "grey.png"), np.array([[0, 127, 128, 255]], np.uint8))
    assert read_mask(tmp_path / "grey.png").tolist() == [[False, False, True, True]]
    cv2.imwrite(str(tmp_path / "deep.png"), np.array([[32767, 32768]], np.uint16))
    assert read_mask(tmp_path / "deep.png").tolist() == [[False, True]]
    cv2.imwrite(str(tmp_path / "green.png"), np.array([[[0, 255, 0], [255, 0, 0]]], np.uint8))
    assert read_mask(tmp_path / "green.png").tolist() == [[True, False]]  # by brightness
    for levels in ((0, 1), (0, 255), (0, 65535)):
        for dtype in (np.uint8, np.uint16)[levels[1] > 255 :]:
            cv2.imwrite(str(tmp_path / "levels.png"), np.array([levels], dtype))
            assert read_mask(tmp_path / "levels.png").tolist() == [[False, True]], (levels, dtype)
            assert read_mask(tmp_path / "levels.png", usable="black").tolist() == [[True, False]]
    cv2.imwrite(str(tmp_path / "alpha.png"), np.array([[[0, 0, 0, 255], [255, 255, 255, 0]]], np.uint8))
    assert read_mask(tmp_path / "alpha.png").tolist() == [[True, False]]
    for level, usable in ((0, "white"), (100, "white"), (255, "black"), (100, "black")):
        cv2.imwrite(str(tmp_path / "nothing.png"), np.full((2, 2), level, np.uint8))
        with pytest.raises(FileFormatError, match=rf"nothing\.png: the mask leaves nothing .* {usable}"):
            read_mask(tmp_path / "nothing.png", usable=usable)  # type: ignore[arg-type]
    cv2.imwrite(str(tmp_path / "labels.png"), np.array([[1, 1, 255]], np.uint8))
    with pytest.raises(FileFormatError, match=r"labels\.png: expected black and white"):
        read_mask(tmp_path / "labels.png")
    with pytest.raises(FileFormatError, match=r"mask\.png: expected 5 x 7 .* got 7 x 5"):
        read_mask(tmp_path / "mask.png", (7, 5))
    with pytest.raises(MissingFileError, match="a mask image expected"):
        read_mask(tmp_path / "nowhere.png")


def claims(width: int, height: int) -> bytes:
    """A PNG of a hundred bytes that says it is a grey image of any size."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    pixels = chunk(b"IDAT", zlib.compress(bytes(50)))
    return b"\x89PNG\r\n\x1a\n" + header + pixels + chunk(b"IEND", b"")


@pytest.mark.parametrize("size", [(20_000, 20_000), (11_600, 11_600)])
def test_a_small_file_that_claims_to_be_huge_costs_no_memory(
    size: tuple[int, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bomb.png").write_bytes(claims(*size))
    monkeypatch.setattr(cv2, "imdecodemulti", lambda *_: pytest.fail("decoded"))
    with pytest.raises(FileFormatError, match=r"bomb\.png: expected an image of at most"):
        read_image(tmp_path / "bomb.png")
    with pytest.raises(FileFormatError, match=r"bomb\.png: expected 48 x 50 pixels"):
        read_image(tmp_path / "bomb.png", (50, 48))


def test_images_of_many_pages_or_passes_are_refused(tmp_path: Path) -> None:
    """Each takes time, however few pixels there are."""
    film, jpeg = tmp_path / "a.gif", tmp_path / "a.jpg"
    pages = [Image.new("L", (2, 2), number % 256) for number in range(300)]
    pages[0].save(film, save_all=True, append_images=pages[1:])
    encoded = cv2.imencode(".jpg", np.eye(64, dtype=np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    last = encoded.rindex(b"\xff\xda")
    jpeg.write_bytes(encoded)
    assert read_image(jpeg).shape == (3, 64, 64)
    jpeg.write_bytes(encoded[:-2] + encoded[last:-2] * 300 + encoded[-2:])
    for path in (film, jpeg):
        with pytest.raises(FileFormatError, match=path.name):
            read_image(path)


@pytest.mark.parametrize(
    ("kind", "brightest", "is_told"),
    [
        (np.uint16, 1000, True),
        (np.uint16, 4000, True),
        (np.uint16, 200, False),
        (np.uint16, 5000, False),
        (np.uint8, 1, True),
        (np.uint8, 2, False),
        (np.uint8, 0, False),
    ],
)
def test_images_of_which_most_values_are_unused_are_asked_about(
    tmp_path: Path, kind: type[np.unsignedinteger], brightest: int, is_told: bool
) -> None:
    image = np.linspace(0, brightest, 48).astype(kind).reshape(6, 8)
    write_pages(tmp_path / "a.png", [image])
    rig = ring_rig(2, image_size=(6, 8))
    for read in (
        lambda: read_image(tmp_path / "a.png"),
        lambda: as_photographs(dict.fromkeys(rig.names, image), rig),
    ):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            read()
        assert any("multiply" in str(warning.message) for warning in caught) == is_told


def test_the_size_is_checked_before_pixels_are_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for suffix in (".png", ".jpg", ".tiff", ".bmp"):
        path = tmp_path / f"a{suffix}"
        write_image(path, torch.rand(3, 6, 9))
        assert read_image(path, (6, 9)).shape == (3, 6, 9)
        with monkeypatch.context() as patch:
            patch.setattr(cv2, "imdecodemulti", lambda *_: pytest.fail("decoded"))
            with pytest.raises(FileFormatError, match=r"expected 6 x 9 .* got 9 x 6"):
                read_image(path, (9, 6))


@pytest.mark.parametrize(
    ("at", "value"), [(16, 60_000), (33, 2**31 - 1)], ids=["width", "length of the data"]
)
def test_damaged_png_takes_no_memory(tmp_path: Path, at: int, value: int) -> None:
    """OpenCV alone would take gigabytes for what the header of a few hundred bytes says."""
    path = tmp_path / "a.png"
    write_image(path, torch.rand(3, 8, 8))
    content = path.read_bytes()
    path.write_bytes(content[:at] + value.to_bytes(4, "big") + content[at + 4 :])
    before = peak()
    with pytest.raises(FileFormatError, match=r"a\.png: cannot be read"):
        read_image(path)
    assert peak() - before < 100 * 2**20
    path.write_bytes(content + b"what other programs leave behind")
    assert read_image(path).shape == (3, 8, 8)


def peak() -> int:
    """Bytes of this process in memory, at most."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
