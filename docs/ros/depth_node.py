# SPDX-License-Identifier: Apache-2.0
"""A ROS 2 node: images of a rig's cameras in, a panorama of depth and a cloud of points out.

ros2 run needs no package for it:  python depth_node.py --ros-args -p calibration:=capture/config.yaml
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import message_filters
import numpy as np
import rclpy
import torch
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image, PointCloud2, PointField
from std_msgs.msg import Header

from sphericalvision import Predictor
from sphericalvision.cameras import read_rig
from sphericalvision.cameras.robot_frame import OPTICAL_FROM_ROS, placed, read_pose
from sphericalvision.capture import Depth

CHANNELS = {"mono8": 1, "rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}
FIELDS = ("x", "y", "z", "rgb")


class DepthNode(Node):
    """Subscribes to ``<camera>/image_raw`` of every camera of the calibration; publishes ``depth`` and ``points``.

    Depth is a panorama (32FC1, metres, NaN where fewer than two cameras look). Points and depth are in the frame
    ``frame_id``: x right, y down, z forward, as ROS has it for optical frames, at the rig of the calibration. With
    ``frame``, a file with the calibration's pose in ``base_link``, points are there: x forward, y left, z up.
    """

    def __init__(self) -> None:
        super().__init__("sphericalvision_depth")
        calibration = self.declare_parameter(
            "calibration", "capture/config.yaml"
        ).value
        level = self.declare_parameter(
            "level", 5
        ).value  # of the icosphere: 6 is finer, at three times the cost
        near = self.declare_parameter(
            "min_depth", 0.0
        ).value  # metres; 0: as the first images ask for
        tolerance = self.declare_parameter(
            "tolerance", 0.02
        ).value  # seconds between images of one moment
        self.rows = self.declare_parameter("rows", 160).value  # of the panorama
        self.min_confidence = self.declare_parameter(
            "min_confidence", 0.5
        ).value  # of points
        frame = self.declare_parameter("frame", "").value
        self.frame_id = self.declare_parameter(
            "frame_id", "base_link" if frame else "rig"
        ).value
        rig = read_rig(calibration)
        self.axes = torch.eye(3)
        if frame:
            rig = placed(rig, OPTICAL_FROM_ROS @ read_pose(frame, "frame"))
            self.axes = OPTICAL_FROM_ROS[:3, :3].mT
        self.names = rig.names
        self.predictor = Predictor(rig, level=level, min_depth=near or "auto")
        self.depth = self.create_publisher(Image, "depth", 1)
        self.points = self.create_publisher(PointCloud2, "points", 1)
        inputs = [
            message_filters.Subscriber(
                self,
                Image,
                f"{name}/image_raw",
                qos_profile=qos_profile_sensor_data,
            )
            for name in self.names
        ]
        # Few wait: what comes while the network works makes room for what is newer.
        self.moments = message_filters.ApproximateTimeSynchronizer(
            inputs, queue_size=2, slop=tolerance
        )
        self.moments.registerCallback(self.on_images)

    def on_images(self, *messages: Image) -> None:
        """Estimate depth of the images of one moment, in the order of the rig."""
        images = {
            name: pixels(message)
            for name, message in zip(self.names, messages, strict=True)
        }
        depth = self.predictor(images)
        header = Header(stamp=messages[0].header.stamp, frame_id=self.frame_id)
        self.depth.publish(depth_message(depth, self.rows, header))
        self.points.publish(
            cloud_message(depth, self.min_confidence, header, self.axes)
        )


def pixels(message: Any) -> np.ndarray:
    """An image as ``(h, w)`` or ``(h, w, 3)``, RGB, without a copy where there is nothing to turn."""
    if message.encoding not in CHANNELS:
        raise ValueError(
            f"encoding: expected one of {', '.join(CHANNELS)}, got {message.encoding}"
        )
    channels = CHANNELS[message.encoding]
    rows = np.frombuffer(message.data, np.uint8).reshape(
        message.height, message.step
    )
    image = rows[:, : message.width * channels].reshape(
        message.height, message.width, channels
    )
    if channels == 1:
        return image[..., 0]
    return (
        image[..., 2::-1] if message.encoding.startswith("bgr") else image[..., :3]
    )


def depth_message(depth: Depth, rows: int, header: Any) -> Image:
    """A panorama of depth, metres."""
    values = depth.panorama(rows).measured.cpu().numpy().astype("<f4")
    height, width = values.shape
    return Image(
        header=header,
        height=height,
        width=width,
        encoding="32FC1",
        is_bigendian=0,
        step=4 * width,
        data=values.tobytes(),
    )


def cloud_message(
    depth: Depth, min_confidence: float, header: Any, axes: torch.Tensor
) -> PointCloud2:
    """Coloured points, turned by ``axes`` ``(3, 3)``; a colour is three bytes in a float, as RViz wants it."""
    cloud = depth.points(min_confidence)
    points = cloud.points.cpu() @ axes.mT
    red, green, blue = (
        (255 * cloud.colors.clamp(0, 1)).round().int().cpu().numpy().T
    )
    packed = (red << 16 | green << 8 | blue).astype("<u4").view("<f4")
    values = np.concatenate((points.numpy().astype("<f4"), packed[:, None]), 1)
    fields = [
        PointField(
            name=name, offset=4 * place, datatype=PointField.FLOAT32, count=1
        )
        for place, name in enumerate(FIELDS)
    ]
    return PointCloud2(
        header=header,
        height=1,
        width=len(values),
        fields=fields,
        is_bigendian=False,
        point_step=16,
        row_step=16 * len(values),
        data=values.tobytes(),
        is_dense=True,
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the node until it is stopped."""
    rclpy.init(args=arguments)
    node = DepthNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main(sys.argv)
