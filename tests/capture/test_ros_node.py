# SPDX-License-Identifier: Apache-2.0
"""The documented ROS 2 node, with stand-ins for ROS: images of one moment become depth and points."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.scenes import make_scene, render_rig

NODE = Path(__file__).resolve().parents[2] / "docs/ros/depth_node.py"
PARAMETERS: dict[str, Any] = {}


class Publisher(list):
    """Keeps what is published."""

    publish = list.append


class Node:
    """What the node uses of ``rclpy.node.Node``."""

    def __init__(self, name: str) -> None:
        self.name, self.topics = name, {}

    def declare_parameter(self, name: str, default: Any) -> SimpleNamespace:
        return SimpleNamespace(value=PARAMETERS.get(name, default))

    def create_publisher(self, kind: type, topic: str, depth: int) -> Publisher:
        return self.topics.setdefault(topic, Publisher())


class Synchronizer:
    """Hands images of one moment on, in the order of its subscribers."""

    def __init__(self, inputs: list[SimpleNamespace], queue_size: int, slop: float) -> None:
        self.topics = [subscriber.topic for subscriber in inputs]

    def registerCallback(self, function: Any) -> None:
        self.signal = function


def module(**names: Any) -> ModuleType:
    made = ModuleType("stand-in")
    vars(made).update(names)
    return made


@pytest.fixture
def node_module(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    kinds = {
        kind: type(kind, (SimpleNamespace,), {"FLOAT32": 7})
        for kind in ("Image", "PointCloud2", "PointField")
    }
    stand_ins = {
        "rclpy": module(),
        "rclpy.node": module(Node=Node),
        "rclpy.qos": module(qos_profile_sensor_data="best effort"),
        "sensor_msgs": module(),
        "sensor_msgs.msg": module(**kinds),
        "std_msgs": module(),
        "std_msgs.msg": module(Header=SimpleNamespace),
        "message_filters": module(
            Subscriber=lambda node, kind, topic, qos_profile: SimpleNamespace(topic=topic),
            ApproximateTimeSynchronizer=Synchronizer,
        ),
    }
    for name, made in stand_ins.items():
        monkeypatch.setitem(sys.modules, name, made)
    spec = importlib.util.spec_from_file_location("depth_node", NODE)
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    yield made
    PARAMETERS.clear()


def message(image: np.ndarray, encoding: str = "rgb8", padding: int = 0) -> SimpleNamespace:
    rows = np.pad(image.reshape(len(image), -1), ((0, 0), (0, padding)))
    header = SimpleNamespace(stamp=12.5, frame_id="camera")
    height, width = image.shape[:2]
    return SimpleNamespace(
        header=header, height=height, width=width, step=rows.shape[1], encoding=encoding, data=rows.tobytes()
    )


def test_all_encodings_are_the_same_picture(node_module: ModuleType) -> None:
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    alpha = np.full((5, 7, 1), 9, np.uint8)
    for encoding, pixels in (
        ("rgb8", image),
        ("bgr8", image[..., ::-1]),
        ("rgba8", np.concatenate((image, alpha), -1)),
        ("bgra8", np.concatenate((image[..., ::-1], alpha), -1)),
    ):
        for padding in (0, 3):
            np.testing.assert_array_equal(node_module.pixels(message(pixels, encoding, padding)), image)
    np.testing.assert_array_equal(node_module.pixels(message(image[..., 0], "mono8")), image[..., 0])
    with pytest.raises(ValueError, match="yuv422"):
        node_module.pixels(message(image, "yuv422"))


def test_images_of_a_moment_become_depth_and_points(node_module: ModuleType, tmp_path: Path) -> None:
    rig: CameraRig = ring_rig(4, image_size=(48, 48))
    rig.to_yaml(tmp_path / "rig.yaml")
    PARAMETERS.update(calibration=str(tmp_path / "rig.yaml"), rows=40, min_depth=0.5)
    node = node_module.DepthNode()
    assert node.moments.topics == [f"cam{number}/image_raw" for number in (1, 2, 3, 4)]
    images = render_rig(make_scene("room", seed=1), rig)
    pictures = {name: (255 * image).byte().movedim(0, -1).numpy() for name, image in images.items()}
    node.moments.signal(*(message(picture) for picture in pictures.values()))

    expected = node.predictor(pictures)
    (depth,) = node.topics["depth"]
    assert (depth.encoding, depth.height, depth.width, depth.step) == ("32FC1", 40, 80, 320)
    assert (depth.header.stamp, depth.header.frame_id) == (12.5, "rig")
    np.testing.assert_allclose(
        np.frombuffer(depth.data, np.float32).reshape(40, 80), expected.panorama(40).measured, rtol=1e-5
    )
    (points,) = node.topics["points"]
    cloud = expected.points(0.5)
    assert points.width == len(cloud.points) > 1000
    assert len(points.data) == points.row_step == points.point_step * points.width
    values = np.frombuffer(points.data, np.float32).reshape(-1, 4)
    np.testing.assert_allclose(values[:, :3], cloud.points, rtol=1e-5)
    colors = values[:, 3].copy().view(np.uint32)
    shades = np.stack((colors >> 16, colors >> 8 & 255, colors & 255), -1)
    np.testing.assert_allclose(shades, 255 * cloud.colors, atol=0.51)
    assert [field.name for field in points.fields] == ["x", "y", "z", "rgb"]
