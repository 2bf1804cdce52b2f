# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS for tests."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rosbag1 = pytest.importorskip("rosbags.rosbag1")
rosbag2 = pytest.importorskip("rosbags.rosbag2")
from rosbags.typesys import Stores, get_typestore  # noqa: E402

RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


def write_bag(
    path: Path,
    messages: Iterable[tuple[str, int, int, Any]],
    storage: str = "mcap",
    size: tuple[int, int] | None = None,
    has_others: bool = False,
    **values: Any,
) -> Path:
    """Write a bag.

    Args:
        path: a folder, or with ``storage="bag"`` a file.
        messages: topic, stamp and time of receipt in nanoseconds, and an RGB picture; or the fields of a message, of
            a compressed one where ``format`` is among them.
        storage: ``"mcap"``, ``"db3"``, or ``"bag"`` of ROS 1.
        size: height and width that all messages state.
        has_others: there is a topic of a type whose definition nobody can read, too.
        values: fields of all messages.
    """
    is_ros1 = storage == "bag"
    types = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
    if is_ros1:
        writer = rosbag1.Writer(path)
    else:
        plugin = rosbag2.StoragePlugin.MCAP if storage == "mcap" else rosbag2.StoragePlugin.SQLITE3
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    connections: dict[str, Any] = {}
    with writer:
        if has_others:
            digest = {"md5sum": "0" * 32} if is_ros1 else {"rihs01": f"RIHS01_{0:064}"}
            writer.add_connection("/state", "driver_msgs/msg/State", msgdef="no ] definition", **digest)
        for topic, stamp, received, content in messages:
            fields = dict(content) if isinstance(content, Mapping) else raw_fields(content)
            fields |= {} if size is None else {"height": size[0], "width": size[1]}
            fields |= values
            kind = COMPRESSED if "format" in fields else RAW
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=types)
            time = types.types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
            head = types.types["std_msgs/msg/Header"](
                stamp=time, frame_id="", **({"seq": 0} if is_ros1 else {})
            )
            message = types.types[kind](header=head, **fields)
            serialize = types.serialize_ros1 if is_ros1 else types.serialize_cdr
            writer.write(connections[topic], received, serialize(message, kind))
    return path


def raw_fields(picture: np.ndarray, encoding: str = "rgb8") -> dict[str, Any]:
    """The fields of a message with a picture, whose rows are padded."""
    height, width = picture.shape[:2]
    rows = np.ascontiguousarray(picture).reshape(height, -1).view(np.uint8)
    padded = np.pad(rows, ((0, 0), (0, 5)))
    return {
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": padded.shape[1],
        "data": padded.ravel(),
    }
