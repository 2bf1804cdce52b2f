# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS: pictures in every encoding are what the camera saw, and topics are found by name or refused."""

from __future__ import annotations

import io
import os
import re
import shutil
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture.sources.bags import Bag, is_part
from sphericalvision.capture.sources.frames import Selection
from sphericalvision.capture.sources.opening import open_source
from sphericalvision.core import ArgumentError, FileFormatError, MissingFileError
from tests.capture.bags import raw_fields, write_bag

RIG = ring_rig(2, image_size=(12, 16))
TIME = 1_700_000_000_000_000_000
PICTURE = np.random.default_rng(0).integers(0, 256, (12, 16, 3), np.uint8)
GREY = PICTURE[..., 0]
DEEP = PICTURE[..., 0].astype(np.uint16) * 256 + PICTURE[..., 1]


def named(*names: str) -> CameraRig:
    return CameraRig(dict(zip(names, RIG.cameras.values(), strict=True)), RIG.world_from_camera)


def of_topics(path: Path, topics: dict[str, Any], **keys: Any) -> Path:
    """A bag with a message of each topic at one time."""
    return write_bag(path, [(topic, TIME, TIME, content) for topic, content in topics.items()], **keys)


def first_image(path: Path, rig: CameraRig = RIG, **keys: Any) -> np.ndarray:
    """The first camera's picture."""
    (frame,) = open_source(str(path), rig, **keys).frames(Selection(), lambda name: True)
    if frame.images is None:
        raise frame.error or AssertionError("no image")
    return np.asarray(next(iter(frame.images.values())))


@pytest.mark.parametrize("storage", ["mcap", "db3", "bag"])
def test_a_bag_is_read_by_its_folder_and_by_its_file(tmp_path: Path, storage: str) -> None:
    path = tmp_path / ("run.bag" if storage == "bag" else "run")
    topics = {f"/{name}/image_raw": PICTURE for name in RIG.names}
    of_topics(path, topics, storage=storage, has_others=True)
    paths = [path] if storage == "bag" else [path, next(path.glob(f"*.{storage}"))]
    if storage == "bag":
        paths.append(shutil.copy(path, tmp_path / "OTHER.BAG.active"))  # its recorder was ended
    else:
        paths.append(shutil.copy(paths[1], tmp_path / f"alone.{storage}"))  # without metadata.yaml
    for images in paths:
        source = open_source(str(images), RIG)
        assert isinstance(source, Bag)
        assert source.names(Selection()) == [str(TIME)]
        assert source.sizes() == dict.fromkeys(RIG.names, (12, 16))
        np.testing.assert_array_equal(first_image(images), PICTURE)


def compressed(format: str, picture: np.ndarray, suffix: str = ".png") -> dict[str, Any]:
    """A compressed message of a picture in OpenCV's order of channels."""
    return {"format": format, "data": cv2.imencode(suffix, picture)[1].ravel()}


BGR = PICTURE[..., ::-1]
MESSAGES: dict[str, tuple[dict[str, Any], np.ndarray]] = {
    "rgb8": (raw_fields(PICTURE, "rgb8"), PICTURE),
    "bgr8": (raw_fields(BGR, "bgr8"), PICTURE),
    "8UC3": (raw_fields(BGR, "8UC3"), PICTURE),
    "rgba8": (raw_fields(np.dstack((PICTURE, GREY)), "rgba8"), PICTURE),
    "bgra8": (raw_fields(np.dstack((BGR, GREY)), "bgra8"), PICTURE),
    "mono8": (raw_fields(GREY, "mono8"), GREY),
    "8UC1": (raw_fields(GREY, "8UC1"), GREY),
    "mono16": (raw_fields(DEEP.astype("<u2"), "mono16"), DEEP),
    "mono16, big end first": (raw_fields(DEEP.astype(">u2"), "mono16") | {"is_bigendian": 1}, DEEP),
    "png": (compressed("png", BGR), PICTURE),
    "rgb8; png compressed bgr8": (compressed("rgb8; png compressed bgr8", BGR), PICTURE),
    "bgr8; png compressed bgr8": (compressed("bgr8; png compressed bgr8", BGR), PICTURE),
    "rgb8; png compressed rgb8": (compressed("rgb8; png compressed rgb8", PICTURE), PICTURE),
    "mono8; png compressed": (compressed("mono8; png compressed ", GREY), GREY),
    "mono16; png compressed": (compressed("mono16; png compressed ", DEEP), DEEP),
}
"""What a message holds, and what was seen."""


@pytest.mark.parametrize(("message", "expected"), MESSAGES.values(), ids=MESSAGES)
def test_a_picture_is_what_was_seen_in_every_encoding(
    tmp_path: Path, message: dict[str, Any], expected: np.ndarray
) -> None:
    image = first_image(of_topics(tmp_path / "run", {f"/{name}/image": message for name in RIG.names}))
    assert image.dtype == expected.dtype
    np.testing.assert_array_equal(image, expected)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("is_compressed", [False, True])
def test_a_mosaic_of_colours_becomes_a_picture(tmp_path: Path, pattern: str, is_compressed: bool) -> None:
    colors = {"r": 200, "g": 100, "b": 20}
    mosaic = np.zeros((12, 16), np.uint8)
    for position, letter in enumerate(pattern):
        mosaic[position // 2 :: 2, position % 2 :: 2] = colors[letter]
    encoding = f"bayer_{pattern}8"
    message = (
        compressed(f"{encoding}; png compressed ", mosaic) if is_compressed else raw_fields(mosaic, encoding)
    )
    image = first_image(of_topics(tmp_path / "run", {f"/{name}/image": message for name in RIG.names}))
    np.testing.assert_array_equal(image[5, 7], list(colors.values()))


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_a_jpeg_is_as_it_is_stored(tmp_path: Path, orientation: int) -> None:
    exif, buffer = Image.Exif(), io.BytesIO()
    exif[0x0112] = orientation
    stored = np.where(np.arange(12)[:, None, None] < 6, 220, np.zeros((12, 16, 3))).astype(np.uint8)
    Image.fromarray(stored).save(buffer, "JPEG", exif=exif, quality=95)
    message = {"format": "jpeg", "data": np.frombuffer(buffer.getvalue(), np.uint8)}
    image = first_image(of_topics(tmp_path / "run", {f"/{name}/image": message for name in RIG.names}))
    np.testing.assert_allclose(image, stored, atol=8)


DAMAGES: dict[str, dict[str, Any]] = {
    "no data": raw_fields(PICTURE) | {"data": np.zeros(0, np.uint8)},
    "short data": raw_fields(PICTURE) | {"data": raw_fields(PICTURE)["data"][:300]},
    "rows shorter than pixels": raw_fields(PICTURE) | {"step": 20},
    "no rows": raw_fields(PICTURE) | {"step": 0},
    "billions of rows": raw_fields(PICTURE) | {"height": 2**32 - 1},
    "no height": raw_fields(PICTURE) | {"height": 0},
    "an unknown encoding": raw_fields(PICTURE, "yuv422"),
    "no picture": {"format": "jpeg", "data": np.arange(99, dtype=np.uint8)},
    "another size": raw_fields(PICTURE[:6]),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_one_damaged_message_is_one_frame(tmp_path: Path, damage: dict[str, Any]) -> None:
    kind = "compressed" if "format" in damage else "raw"
    topics = {name: f"/{name}/{kind}" for name in RIG.names}
    whole = compressed("png", BGR) if kind == "compressed" else PICTURE
    contents = [(topics["cam1"], whole), (topics["cam2"], whole)] * 2
    contents[3:] = [(topics["cam2"], damage)]
    messages = [
        (topic, TIME + step // 2 * 10**8, TIME, content) for step, (topic, content) in enumerate(contents)
    ]
    frames = list(
        open_source(str(write_bag(tmp_path / "run", messages)), RIG).frames(Selection(), lambda _: True)
    )
    assert [frame.images is None for frame in frames] == [False, True]
    assert isinstance(frames[1].error, FileFormatError)
    assert f"run: {topics['cam2']}" in str(frames[1].error)


def test_a_stamp_that_was_not_set_is_no_time(tmp_path: Path) -> None:
    """The first camera's driver sets it late, the second's stops early: these are not of one moment."""
    steps = {"cam1": range(1, 20), "cam2": range(19)}
    messages = [
        (f"/{name}/image", TIME + step * 10**8 if step in steps[name] else 0, TIME, PICTURE)
        for name in RIG.names
        for step in range(20)
    ]
    source = open_source(str(write_bag(tmp_path / "run", messages)), RIG)
    assert source.names(Selection()) == [str(TIME + step * 10**8) for step in range(1, 19)]


@pytest.mark.parametrize("later", [10**6, 10**10])
def test_a_message_that_was_recorded_twice_is_one_and_it_is_told(tmp_path: Path, later: int) -> None:
    """By two recorders at once, or in bags that were joined."""
    messages = [
        (f"/{name}/image", TIME + step * 10**8, TIME + step * 10**8 + again, np.full_like(PICTURE, step))
        for step in range(4)
        for name in RIG.names
        for again in (0, later)
    ]
    with pytest.warns(UserWarning, match=r"4 repeated message\(s\) of /cam1/image"):
        source = open_source(str(write_bag(tmp_path / "run", messages)), RIG)
    assert source.names(Selection()) == [str(TIME + step * 10**8) for step in range(4)]


@pytest.mark.parametrize(
    ("zeros", "delays", "source"),
    [
        (
            (10**9 - TIME, 4 * 10**9 - TIME),
            (0, 0),
            "received",
        ),  # devices that count from when they were switched on
        ((0, 18 * 10**12), (0, 0), "received"),  # another time zone
        ((0, 2 * 10**9), (0, 0), "received"),  # stamps of what is to come
        ((0, 0), (0, 3 * 10**9), "stamps"),  # a slow way
        ((10**9 - TIME, 10**9 - TIME), (10**7, 2 * 10**7), "stamps"),
    ],
)
def test_stamps_of_clocks_of_their_own_are_not_compared(
    tmp_path: Path, zeros: tuple[int, int], delays: tuple[int, int], source: str
) -> None:
    """Images are of one moment by the better of the two clocks, and it is said where stamps do not count."""
    messages = [
        (
            f"/{name}/image",
            TIME + step * 10**8 + zero,
            TIME + step * 10**8 + delay,
            np.full_like(PICTURE, step),
        )
        for name, zero, delay in zip(RIG.names, zeros, delays, strict=True)
        for step in range(60)
    ]
    bag = open_source(str(write_bag(tmp_path / "run", sorted(messages, key=lambda message: message[2]))), RIG)
    assert source in bag.pairing
    assert len(bag.notes) == (source == "received")
    frames = list(bag.frames(Selection(), lambda _: True))
    assert len(frames) == 60
    for frame in frames:
        first, second = (frame.images or {}).values()
        np.testing.assert_array_equal(first, second)


def test_stamps_of_another_unit_do_not_count(tmp_path: Path) -> None:
    """One driver writes microseconds where nanoseconds belong: images of a second are in a thousandth of it."""
    messages = [
        (f"/{name}/image", time // 10**9 * 10**9 + time % 10**9 // divisor, time, np.full_like(PICTURE, step))
        for step in range(40)
        for name, divisor, lost in zip(RIG.names, (1, 1000), (12, 25), strict=True)
        if step != lost and (time := TIME + step * 10**8 + 10**7)
    ]
    with pytest.warns(UserWarning, match=r"of cam2 0\.1 s apart"):
        bag = open_source(str(write_bag(tmp_path / "run", messages)), RIG)
    frames = list(bag.frames(Selection(), lambda _: True))
    assert len(frames) == 38
    assert all(len({int(image.max()) for image in (frame.images or {}).values()}) == 1 for frame in frames)


def test_a_file_that_metadata_does_not_name_is_a_bag_of_its_own(tmp_path: Path) -> None:
    first, second = (
        of_topics(
            tmp_path / str(level), {f"/{name}/image": np.full_like(PICTURE, level) for name in RIG.names}
        )
        for level in (1, 2)
    )
    stray = shutil.copy(second / "2.mcap", first / "stray.mcap")
    assert [is_part(first / f"{name}.mcap.zstd") for name in ("1", "stray")] == [True, False]
    assert first_image(stray).max() == 2
    with pytest.warns(UserWarning, match=r"left out are stray\.mcap"):
        assert first_image(first).max() == 1


@pytest.mark.parametrize(("count", "suffix"), [(1, "/compressed"), (2, ""), (4, "")])
def test_of_raw_and_compressed_pictures_those_count_that_were_recorded(
    tmp_path: Path, count: int, suffix: str
) -> None:
    """Raw ones, as they are as the camera saw them, unless hardly any is there."""
    messages = [
        (f"/{name}/image{end}", TIME + k * 10**8, TIME + k * 10**8, content)
        for name in RIG.names
        for end, content, number in (("", PICTURE, count), ("/compressed", compressed("png", BGR), 4))
        for k in range(number)
    ]
    source = open_source(str(write_bag(tmp_path / "run", messages)), RIG)
    assert isinstance(source, Bag)
    assert set(source.topics.values()) == {f"/{name}/image{suffix}" for name in RIG.names}


@pytest.mark.parametrize(("faster", "is_told"), [(1.005, True), (1.0, False)])
def test_a_clock_that_runs_faster_than_the_other_is_told(
    tmp_path: Path, faster: float, is_told: bool
) -> None:
    ways = np.random.default_rng(0).uniform(0, 2e7, 90).astype(int)  # of unlike lengths, 20 ms at most
    messages = [
        (f"/{name}/image", int(TIME + k * 10**8 * rate), TIME + k * 10**8 + int(way), PICTURE)
        for name, rate in zip(RIG.names, (1.0, faster), strict=True)
        for k, way in enumerate(ways)
    ]
    bag = write_bag(tmp_path / "run", sorted(messages, key=lambda message: message[2]))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        open_source(str(bag), RIG)
    assert any("drift" in str(warning.message) for warning in caught) == is_told


TOPICS: dict[str, tuple[list[str], tuple[str, str], dict[str, str] | None]] = {
    "names between slashes": (["/b/image", "/a/image"], ("a", "b"), {"a": "/a/image", "b": "/b/image"}),
    "names as words": (
        ["/cam_back/image_raw", "/cam_front/image_raw"],
        ("front", "back"),
        {"front": "/cam_front/image_raw", "back": "/cam_back/image_raw"},
    ),
    "a name within another": (
        ["/front/image", "/front_wide/image"],
        ("front", "front_wide"),
        {"front": "/front/image", "front_wide": "/front_wide/image"},
    ),
    "a name that says more": (["/a_rear/image", "/b/image"], ("a", "b"), None),
    "a number that says more": (["/a2/image", "/b/image"], ("a", "b"), None),
    "words behind it": (["/a/rear/image", "/b/image"], ("a", "b"), None),
    "pictures for debugging are raw": (
        ["/view_1", "/view_2", "/a/image/compressed", "/b/image/compressed"],
        ("a", "b"),
        {"a": "/a/image/compressed", "b": "/b/image/compressed"},
    ),
    "raw and compressed": (
        ["/a/image", "/b/image", "/a/image/compressed", "/b/image/compressed"],
        ("a", "b"),
        {"a": "/a/image", "b": "/b/image"},
    ),
    "depth of each camera": (
        ["/a/image", "/b/image", "/a/depth", "/b/depth"],
        ("a", "b"),
        {"a": "/a/image", "b": "/b/image"},
    ),
    "numbers": (
        ["/camera_0/image", "/camera_1/image"],
        ("a", "b"),
        {"a": "/camera_0/image", "b": "/camera_1/image"},
    ),
    "other names": (["/left/image", "/right/image"], ("front", "back"), None),
    "two of a name": (["/a/image", "/a/picture", "/b/image"], ("a", "b"), None),
    "one of them": (["/a/image", "/c/image"], ("a", "b"), None),
}
"""Topics of a bag, names of cameras, and which is whose; None where it cannot be told."""


@pytest.mark.parametrize(("topics", "names", "expected"), TOPICS.values(), ids=TOPICS)
def test_topics_are_the_cameras_by_name_or_number_or_are_asked_for(
    tmp_path: Path, topics: list[str], names: tuple[str, str], expected: dict[str, str] | None
) -> None:
    contents = {
        topic: compressed("png", BGR)
        if topic.endswith("compressed")
        else raw_fields(DEEP, "16UC1")
        if topic.endswith("depth")
        else PICTURE
        for topic in topics
    }
    path, rig = of_topics(tmp_path / "run", contents), named(*names)
    if expected is not None:
        source = open_source(str(path), rig)
        assert isinstance(source, Bag)
        assert source.topics == expected
        assert source.labels == ({} if all(n in t.split("/") for n, t in expected.items()) else expected)
        return
    with pytest.raises(ArgumentError, match=r"cameras=\[.*:/topic") as refused:
        open_source(str(path), rig)
    assert all(topic in str(refused.value) for topic in topics)
    labels = dict(zip(names, topics[::-1], strict=False))
    source = open_source(str(path), rig, labels=labels)
    assert isinstance(source, Bag)
    assert source.topics == labels


def test_a_pipe_in_a_bag_is_not_waited_for(tmp_path: Path) -> None:
    bag = of_topics(tmp_path / "run", {f"/{name}/image_raw": PICTURE for name in RIG.names})
    (file,) = bag.glob("*.mcap")
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(FileFormatError, match=file.name):
        open_source(str(bag), RIG)


def test_what_is_no_bag_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = of_topics(tmp_path / "run", {f"/{name}/image": PICTURE for name in RIG.names})
    with pytest.raises(ArgumentError, match="frames"):
        open_source(str(path), RIG, frames=[1])
    for missing in ("missing.mcap", "{camera}.bag"):
        with pytest.raises(MissingFileError, match=f"{re.escape(missing)}.*rosbags-convert"):
            open_source(str(tmp_path / missing), RIG)
    deep = of_topics(tmp_path / "deep", {"/cam1/image": raw_fields(np.dstack([DEEP] * 3), "16UC3")})
    with pytest.raises(ArgumentError, match=r"/cam1/image .*16UC3"):
        open_source(str(deep), RIG)
    for name in ("empty.bag", "empty.mcap", "empty.db3"):
        (tmp_path / name).touch()
        with pytest.raises(FileFormatError, match=name):
            open_source(str(tmp_path / name), RIG)
    monkeypatch.setattr("sphericalvision.capture.sources.bags.find_spec", lambda name: None)
    with pytest.raises(ArgumentError, match=r"pip install rosbags"):
        open_source(str(path), RIG)
