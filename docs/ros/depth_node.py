# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: E402
"""A ROS 2 node: images of a rig's cameras in; a panorama of depth, points, pinhole images of depth and a scan out.

ros2 run needs no package for it:  python depth_node.py --ros-args -p calibration:=capture/config.yaml
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import Any

from sphericalvision.threads import prepare_threads

prepare_threads()  # before torch: a robot's cores have other work

import cv2
import message_filters
import numpy as np
import rclpy
import torch
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import (
    CameraInfo,
    CompressedImage,
    Image,
    LaserScan,
    PointCloud2,
    PointField,
)
from std_msgs.msg import Header
from tf2_ros import StaticTransformBroadcaster

from sphericalvision import Predictor
from sphericalvision.cameras import PinholeCamera, read_rig
from sphericalvision.cameras.robot_frame import OPTICAL_FROM_ROS, placed, read_pose
from sphericalvision.capture import Depth
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.geometry.transforms import axis_angle_from_transform
from sphericalvision.sphere import Equirectangular

CHANNELS = {"mono8": 1, "rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}
FIELDS = ("x", "y", "z", "rgb")


class DepthNode(Node):
    """Subscribes to ``<camera>/image_raw`` of every camera of the calibration; publishes ``depth`` and ``points``.

    With ``compressed`` it subscribes to ``<camera>/image_raw/compressed``.

    Depth is a panorama (32FC1, metres, NaN where fewer than two cameras look). Points and depth are in the frame
    ``frame_id``: x right, y down, z forward, as ROS has it for optical frames, at the rig of the calibration. With
    ``frame``, a file with the calibration's pose in ``base_link``, points are there: x forward, y left, z up.

    For programs that take pinhole cameras, ``panels`` of them stand at the rig's centre and look around the
    horizon: ``panel_0`` forward, the others to the right of it. Each has ``panel_0/depth`` (32FC1, metres along the
    optical axis), ``panel_0/camera_info`` and a static transform. With ``scan_top`` above ``scan_bottom``, heights
    in the robot's frame, ``scan`` is what lies between them as a laser scanner at the robot's origin would see it,
    which needs ``frame``.
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
        compressed = self.declare_parameter("compressed", False).value
        panels = self.declare_parameter("panels", 0).value  # 3 or more, or none
        side = self.declare_parameter("panel_size", 240).value  # pixels
        self.heights = [  # metres
            self.declare_parameter(name, 0.0).value
            for name in ("scan_bottom", "scan_top")
        ]
        frame = self.declare_parameter("frame", "").value
        self.frame_id = self.declare_parameter(
            "frame_id", "base_link" if frame else "rig"
        ).value
        rig = read_rig(calibration)
        self.axes = torch.eye(3)
        if frame:
            rig = placed(rig, OPTICAL_FROM_ROS @ read_pose(frame, "frame").float())
            self.axes = OPTICAL_FROM_ROS[:3, :3].mT
        self.names = rig.names
        self.scans = self.heights[1] > self.heights[0]
        if self.scans and not frame:
            raise ValueError(
                "scan_top: heights are those of a robot's frame; give frame, a file with the calibration's pose in it"
            )
        if panels and panels < 3:
            raise ValueError(f"panels: expected 3 or more, or 0, got {panels}")
        self.predictor = Predictor(rig, level=level, min_depth=near or "auto")
        self.depth = self.create_publisher(Image, "depth", 1)
        self.points = self.create_publisher(PointCloud2, "points", 1)
        self.scan = self.create_publisher(LaserScan, "scan", 1)
        self.panel = PinholeCamera.from_field_of_view(
            (side, side), 2 * math.pi / max(panels, 3)
        )
        self.panel_poses = [
            transform_from_axis_angle(
                torch.tensor([0.0, 2 * math.pi * place / panels, 0.0]), rig.center
            )
            for place in range(panels)
        ]
        self.panels = [
            (
                self.create_publisher(Image, f"panel_{place}/depth", 1),
                self.create_publisher(CameraInfo, f"panel_{place}/camera_info", 1),
            )
            for place in range(panels)
        ]
        self.transforms = StaticTransformBroadcaster(self)
        self.transforms.sendTransform(
            [
                transform_message(
                    pose, self.axes, self.frame_id, f"{self.frame_id}_panel_{place}"
                )
                for place, pose in enumerate(self.panel_poses)
            ]
        )
        inputs = [
            message_filters.Subscriber(
                self,
                CompressedImage if compressed else Image,
                f"{name}/image_raw{'/compressed' if compressed else ''}",
                qos_profile=qos_profile_sensor_data,
            )
            for name in self.names
        ]
        # Few wait: what comes while the network works makes room for what is newer.
        self.moments = message_filters.ApproximateTimeSynchronizer(
            inputs, queue_size=2, slop=tolerance
        )
        self.moments.registerCallback(self.on_images)

    def on_images(self, *messages: Any) -> None:
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
        if self.scans:
            self.scan.publish(
                scan_message(depth, self.rows, self.heights, header, self.axes)
            )
        for place, (pose, (images_of, info)) in enumerate(
            zip(self.panel_poses, self.panels, strict=True)
        ):
            header = Header(
                stamp=messages[0].header.stamp,
                frame_id=f"{self.frame_id}_panel_{place}",
            )
            images_of.publish(panel_message(depth, self.panel, pose, header))
            info.publish(info_message(self.panel, header))


def pixels(message: Any) -> np.ndarray:
    """An image as ``(h, w)`` or ``(h, w, 3)``, RGB, without a copy where there is nothing to turn."""
    if not hasattr(message, "encoding"):  # compressed
        picture = cv2.imdecode(
            np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR
        )
        if picture is None:
            raise ValueError(
                f"format: expected a picture that OpenCV reads (JPEG, PNG), got {message.format}"
            )
        return picture[..., ::-1]
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
    return float_image(depth.panorama(rows).measured, header)


def panel_message(
    depth: Depth, camera: PinholeCamera, pose: torch.Tensor, header: Any
) -> Image:
    """Depth of a pinhole camera, metres along its optical axis."""
    axis = camera.unproject(camera.pixel_grid()).directions[..., 2]
    return float_image(depth.camera(camera, pose).measured.cpu() * axis, header)


def float_image(values: torch.Tensor, header: Any) -> Image:
    """A message of values ``(h, w)``; NaN where there are none."""
    height, width = values.shape
    return Image(
        header=header,
        height=height,
        width=width,
        encoding="32FC1",
        is_bigendian=0,
        step=4 * width,
        data=values.cpu().numpy().astype("<f4").tobytes(),
    )


def info_message(camera: PinholeCamera, header: Any) -> CameraInfo:
    """Intrinsics of a pinhole camera."""
    (height, width), (u, v) = camera.image_size, camera.principal_point.tolist()
    across, down = camera.focal_length.tolist()
    return CameraInfo(
        header=header,
        height=height,
        width=width,
        distortion_model="plumb_bob",
        d=[0.0] * 5,
        k=[across, 0.0, u, 0.0, down, v, 0.0, 0.0, 1.0],
        r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p=[across, 0.0, u, 0.0, 0.0, down, v, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def transform_message(
    pose: torch.Tensor, axes: torch.Tensor, parent: str, child: str
) -> TransformStamped:
    """A pose ``(4, 4)`` in optical axes as one in those that ``axes`` ``(3, 3)`` turn them into."""
    turned = torch.eye(4, dtype=torch.float64)
    turned[:3] = axes.double() @ pose[:3].double()
    vector, place = axis_angle_from_transform(turned)
    half = vector.norm() / 2
    x, y, z = (vector / 2 * torch.sinc(half / math.pi)).tolist()
    return TransformStamped(
        header=Header(frame_id=parent),
        child_frame_id=child,
        transform=Transform(
            translation=Vector3(**dict(zip("xyz", place.tolist(), strict=True))),
            rotation=Quaternion(x=x, y=y, z=z, w=math.cos(half)),
        ),
    )


def scan_message(
    depth: Depth,
    rows: int,
    heights: Sequence[float],
    header: Any,
    axes: torch.Tensor,
) -> LaserScan:
    """The nearest of what lies between two heights in each direction; infinity where nothing does.

    There is a beam for each two columns of the panorama: seen from the robot's origin they are not evenly spaced.
    """
    metres = depth.panorama(rows).measured.cpu()
    rays = Equirectangular(rows, 2 * rows).directions
    points = (depth.rig.center.cpu() + metres[..., None] * rays) @ axes.mT
    height = points[..., 2]
    x, y = points[(height >= heights[0]) & (height <= heights[1])][:, :2].mT
    step = 2 * math.pi / rows
    ranges = torch.full((rows,), math.inf)
    beams = ((torch.atan2(y, x) + math.pi) / step).long() % rows
    ranges.scatter_reduce_(0, beams, x.hypot(y), "amin")
    return LaserScan(
        header=header,
        angle_min=-math.pi + step / 2,
        angle_max=math.pi - step / 2,
        angle_increment=step,
        range_min=0.0,
        range_max=float(depth.max_depth),
        ranges=ranges.tolist(),
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
