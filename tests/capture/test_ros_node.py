# SPDX-License-Identifier: Apache-2.0
"""The documented ROS 2 node, with stand-ins for ROS: images of one moment become depth and points."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import Depth
from sphericalvision.models import WinnerTakesAll
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


class Broadcaster:
    """Keeps the transforms that are sent."""

    def __init__(self, node: Node) -> None:
        node.transforms_sent = []
        self.sendTransform = node.transforms_sent.extend


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
        for kind in (
            *("CameraInfo", "CompressedImage", "Image", "LaserScan", "PointCloud2", "PointField"),
            *("Quaternion", "Transform", "TransformStamped", "Vector3"),
        )
    }
    stand_ins = {
        "rclpy": module(),
        "rclpy.node": module(Node=Node),
        "rclpy.qos": module(qos_profile_sensor_data="best effort"),
        "geometry_msgs": module(),
        "geometry_msgs.msg": module(**kinds),
        "tf2_ros": module(StaticTransformBroadcaster=Broadcaster),
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


def test_compressed_pictures_are_read(node_module: ModuleType, tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    data = cv2.imencode(".png", image[..., ::-1])[1].tobytes()
    np.testing.assert_array_equal(node_module.pixels(SimpleNamespace(format="png", data=data)), image)
    with pytest.raises(ValueError, match=r"format: expected a picture .* got draco"):
        node_module.pixels(SimpleNamespace(format="draco", data=b"abc"))
    ring_rig(2, image_size=(16, 16)).to_yaml(tmp_path / "rig.yaml")
    PARAMETERS.update(calibration=str(tmp_path / "rig.yaml"), compressed=True, min_depth=0.5)
    assert node_module.DepthNode().moments.topics == [f"cam{n}/image_raw/compressed" for n in (1, 2)]


def test_panels_and_scan_show_where_the_walls_of_a_robots_room_are(
    node_module: ModuleType, tmp_path: Path
) -> None:
    """Around a ball of 3 m whose centre is the rig, a metre above and 0.5 m before the robot's origin."""
    rig = ring_rig(3, image_size=(24, 24))
    rig.to_yaml(tmp_path / "rig.yaml")
    base = np.eye(4)[:3]
    base[:, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    base[:, 3] = [0.5, 0.0, 1.0]
    np.savetxt(tmp_path / "base.txt", base.reshape(1, 12))
    PARAMETERS.update(calibration=str(tmp_path / "rig.yaml"), scan_top=1.5, min_depth=0.5, panels=4)
    with pytest.raises(ValueError, match=r"scan_top: .* give frame"):
        node_module.DepthNode()
    PARAMETERS.update(frame=str(tmp_path / "base.txt"), scan_bottom=0.5)
    node = node_module.DepthNode()
    placed_rig = node.predictor.rig
    net = WinnerTakesAll(3, 8, 0.5, depth_coarsening=0)
    dark = {name: torch.zeros(3, 24, 24) for name in rig.names}
    index, ones = torch.full((642,), 7 * 0.5 / 3), torch.ones(642)
    node.predictor = lambda images: Depth(index, ones, ones > 0, net, placed_rig, dark)
    blank = np.zeros((24, 24, 3), np.uint8)
    node.moments.signal(*[message(blank)] * 3)

    (scan,) = node.topics["scan"]
    ranges = np.array(scan.ranges)
    angles = scan.angle_min + scan.angle_increment * np.arange(len(ranges))
    assert angles[-1] == pytest.approx(scan.angle_max)
    seen = np.isfinite(ranges)
    assert seen.mean() > 0.9
    away = np.hypot(ranges * np.cos(angles) - 0.5, ranges * np.sin(angles))[seen]
    assert (away < 3.02).all()  # at the height of the rig
    assert (away > 2.93).all()  # half a metre above and below

    (info,) = node.topics["panel_1/camera_info"]
    (panel,) = node.topics["panel_1/depth"]
    values = np.frombuffer(panel.data, np.float32).reshape(panel.height, panel.width)
    across, _, u, _, down, v, *_ = info.k
    rows, columns = np.mgrid[: panel.height, : panel.width]
    local = np.stack(((columns - u) / across * values, (rows - v) / down * values, values), -1)
    np.testing.assert_allclose(np.linalg.norm(local, axis=-1), 3, atol=0.02)
    assert panel.header.frame_id == info.header.frame_id == "base_link_panel_1"
    sent = node.transforms_sent[1]
    assert (sent.header.frame_id, sent.child_frame_id) == ("base_link", "base_link_panel_1")
    place, turn = vars(sent.transform.translation), vars(sent.transform.rotation)
    assert [place[axis] for axis in "xyz"] == pytest.approx([0.5, 0.0, 1.0], abs=1e-6)
    in_base = Rotation.from_quat([turn[axis] for axis in "xyzw"]).apply([0, 0, 1])
    np.testing.assert_allclose(in_base, [0, -1, 0], atol=1e-6)  # the optical axis, to the right of forward
