# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS: four topics of images are the frames that the pictures are; what is not understood is told."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture.sources.bags import Bag
from sphericalvision.capture.sources.frames import Selection
from sphericalvision.capture.sources.opening import open_source
from sphericalvision.core import ArgumentError, FileFormatError, MissingFileError

rosbag1 = pytest.importorskip("rosbags.rosbag1")
rosbag2 = pytest.importorskip("rosbags.rosbag2")
from rosbags.typesys import Stores, get_typestore  # noqa: E402

RIG = ring_rig(4, image_size=(12, 16))
START = 1_700_000_000_000_000_000
STEP = 100_000_000
PICTURES = {
    name: np.random.default_rng(place).integers(0, 256, (3, 12, 16, 3), np.uint8)
    for place, name in enumerate(RIG.names)
}
"""Of each camera three, a tenth of a second apart; the cameras are 2 ms apart."""


def write(path: Path, kind: str = "mcap", encoding: str = "rgb8", topic: str = "/{name}/image_raw") -> Path:
    """A bag of these pictures; the last camera lacks the last one."""
    ros1 = kind == "bag"
    types = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.LATEST)
    header, time = types.types["std_msgs/msg/Header"], types.types["builtin_interfaces/msg/Time"]
    if ros1:
        writer = rosbag1.Writer(path)
    else:
        plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    with writer:
        for place, (name, pictures) in enumerate(PICTURES.items()):
            compressed = encoding in ("png", "nonsense")
            message_type = f"sensor_msgs/msg/{'CompressedImage' if compressed else 'Image'}"
            connection = writer.add_connection(
                topic.format(name=name, place=place), message_type, typestore=types
            )
            for number, picture in enumerate(pictures[: 2 if name == "cam4" else 3]):
                stamp = START + STEP * number + 2_000_000 * place
                values: dict[str, Any] = {"seq": 0} if ros1 else {}
                head = header(stamp=time(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id=name, **values)
                if compressed:
                    ok = encoding == "png"
                    data = cv2.imencode(".png", picture[..., ::-1])[1] if ok else np.arange(9, dtype=np.uint8)
                    message = types.types[message_type](header=head, format=encoding, data=data)
                else:
                    pixels = picture[..., ::-1] if encoding == "bgr8" else picture
                    pixels = np.pad(pixels.reshape(12, 48), ((0, 0), (0, 5)))  # rows may be padded
                    message = types.types[message_type](
                        header=head,
                        height=12,
                        width=16,
                        encoding=encoding,
                        is_bigendian=0,
                        step=53,
                        data=pixels.flatten(),
                    )
                if ros1:
                    raw = types.serialize_ros1(message, message_type)
                else:
                    raw = types.serialize_cdr(message, message_type)
                writer.write(connection, stamp + 3_000_000, raw)  # recorded later than taken
    return path


@pytest.mark.parametrize(
    ("kind", "encoding"), [("mcap", "rgb8"), ("mcap", "png"), ("db3", "bgr8"), ("bag", "rgb8")]
)
@pytest.mark.parametrize("cameras", [None, ["cam3", "cam1"]])
def test_a_bag_of_topics_is_the_frames_of_its_pictures(
    tmp_path: Path, kind: str, encoding: str, cameras: list[str] | None
) -> None:
    path = write(tmp_path / ("run.bag" if kind == "bag" else "run"), kind, encoding)
    places = [path] if kind == "bag" else [path, next(path.glob(f"*.{kind}"))]
    if kind != "bag":
        places.append(shutil.copy(places[1], tmp_path / f"alone.{kind}"))  # without metadata.yaml
    for images in places:
        source = open_source(str(images), RIG, cameras=cameras)
        assert isinstance(source, Bag)
        used = cameras or list(RIG.names)
        assert source.sizes() == dict.fromkeys(used, (12, 16))
        assert not source.labels
        first = START + 2_000_000 * RIG.names.index(used[0])
        numbers = range(2) if cameras is None else range(3)
        assert source.names(Selection()) == [str(first + STEP * number) for number in numbers]
        assert len(source.samples()) >= 2
        for number, frame in enumerate(source.frames(Selection(), lambda name: True)):
            assert frame.images is not None
            assert list(frame.images) == used
            for name, image in frame.images.items():
                np.testing.assert_array_equal(image, PICTURES[name][number])


def test_topics_of_other_names_belong_to_cameras_in_their_order(tmp_path: Path) -> None:
    source = open_source(str(write(tmp_path / "run", topic="/camera_{place}/image")), RIG, cameras=["cam2"])
    assert source.labels == {"cam2": "/camera_1/image"}
    (frame,) = source.frames(Selection(1, 2), lambda name: True)
    assert frame.images is not None
    np.testing.assert_array_equal(frame.images["cam2"], PICTURES["cam2"][1])


def test_pictures_of_another_size_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PICTURES, "cam2", [PICTURES["cam2"][0], PICTURES["cam2"][1, :6, :8]])
    source = open_source(str(write(tmp_path / "run", encoding="png")), RIG)
    first, second = source.frames(Selection(), lambda name: True)
    assert first.images is not None
    assert "/cam2/image_raw: expected pictures of 16 x 12 pixels (width" in str(second.error)
    assert str(second.error).endswith("got one of 8 x 6")


def test_a_mosaic_of_colours_becomes_a_picture(tmp_path: Path) -> None:
    source = open_source(str(write(tmp_path / "run", encoding="bayer_rggb8")), RIG)
    image = next(iter(source.samples())).images["cam1"]  # type: ignore[index]
    assert image.shape == (12, 16, 3)
    mosaic = np.ascontiguousarray(PICTURES["cam1"][0].reshape(12, 48)[:, :16])
    assert image[2, 2, 0] == mosaic[2, 2]  # red is where the sensor saw it
    assert image[3, 3, 2] == mosaic[3, 3]


def test_what_is_no_bag_of_these_cameras_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "run")
    with pytest.raises(
        ArgumentError, match=r"topic of images for each of left, .* got /cam1/image_raw \(Image\)"
    ):
        open_source(
            str(path),
            CameraRig(dict.fromkeys(("left", "right"), RIG.cameras["cam1"]), RIG.world_from_camera[:2]),
        )
    with pytest.raises(ArgumentError, match="of videos, bags and live"):
        open_source(str(path), RIG, frames=[1])
    with pytest.raises(MissingFileError, match=r"no moment .* tolerance=0.0001 .*cam1: 3, .* cam4: 2"):
        open_source(str(path), RIG, tolerance=0.0001)
    with pytest.raises(MissingFileError, match=r"folder with metadata.yaml"):
        open_source(str(tmp_path / "missing.mcap"), RIG)
    cut = next(path.glob("*.mcap")).read_bytes()[:-50]  # the recording was killed
    for name, content in {"empty.bag": b"", "empty.mcap": b"", "empty.db3": b"", "cut.mcap": cut}.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FileFormatError, match=f"{name}: rosbags cannot read it"):
            open_source(str(tmp_path / name), RIG)
    for encoding, words in {
        "yuv422": "encoding mono8, .* got 'yuv422'",
        "nonsense": "format 'nonsense'",
    }.items():
        source = open_source(str(write(tmp_path / encoding, encoding=encoding)), RIG)
        frame = next(iter(source.frames(Selection(), lambda name: True)))
        with pytest.raises(FileFormatError, match=words):
            raise frame.error or AssertionError("it was read")
    monkeypatch.setattr("sphericalvision.capture.sources.bags.find_spec", lambda name: None)
    with pytest.raises(ArgumentError, match=r"sphericalvision\[bags\]"):
        open_source(str(path), RIG)
