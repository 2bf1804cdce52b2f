# SPDX-License-Identifier: Apache-2.0
"""Frames as a recording of Rerun: cameras, images, depth and points on a time line (``pip install rerun-sdk``)."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any, Self

import torch

from sphericalvision.cameras import Camera
from sphericalvision.capture.pinhole_twins import PinholeTwin, pinhole_twins
from sphericalvision.capture.result import Depth
from sphericalvision.core import ArgumentError
from sphericalvision.io.files import atomic_write
from sphericalvision.io.images import as_bytes
from sphericalvision.viz.panorama import rgb_panorama


class RerunLog:
    """Writes frame after frame into a file that ``rerun FILE.rrd`` shows.

    ``world`` has x right, y down, z forward. In it are ``world/<camera>`` with pose and ``image``, its pinhole twins
    ``world/<camera>/<view>`` with an image each, into which Rerun projects the points, and ``world/points``; beside it
    the panoramas ``color``, ``depth`` (metres) and ``confidence``.

    Args:
        path: of the recording; it appears when the log is closed.
        height: rows of the panoramas.

    Raises:
        ArgumentError: Rerun is not installed.

    References:
        https://rerun.io/docs

    Examples:
        >>> with RerunLog("rooms.rrd") as log:  # doctest: +SKIP
        ...     log.add(0, predictor(images))
    """

    def __init__(self, path: str | Path, height: int = 256) -> None:
        try:
            self._rerun = import_module("rerun")
        except ImportError:
            raise ArgumentError("rerun: not installed; pip install rerun-sdk") from None
        self.path, self.height = Path(path), height
        self._writing = atomic_write(self.path)
        self._stream = self._rerun.RecordingStream("sphericalvision")
        self._stream.save(self._writing.__enter__())
        self._origin: torch.Tensor | None = None
        self._twins: list[tuple[Camera, list[PinholeTwin]]] = []
        self._stream.log("world", self._rerun.ViewCoordinates.RDF, static=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    @torch.inference_mode()
    def add(self, number: int, depth: Depth) -> None:
        """Write one frame at a place of the time line ``frame``."""
        rr, stream = self._rerun, self._stream
        stream.set_time("frame", sequence=number)
        rig = depth.rig.to("cpu")
        images = {name: image.cpu() for name, image in depth.images.items()}
        self._origin = rig.origin if self._origin is None else self._origin  # one for all frames
        offset = (rig.origin - self._origin).float()
        for name, pose in zip(rig.names, rig.world_from_camera.float().numpy(), strict=True):
            position = pose[:3, 3] + offset.numpy()
            stream.log(f"world/{name}", rr.Transform3D(translation=position, mat3x3=pose[:3, :3]))
            stream.log(f"world/{name}/image", rr.Image(as_bytes(images[name])).compress())
            for twin in self._twins_of(rig.cameras[name]):
                entity = f"world/{name}/{twin.name or 'pinhole'}"
                focal, center = twin.camera.focal_length.tolist(), twin.camera.principal_point.tolist()
                pinhole = rr.Pinhole(
                    focal_length=focal,
                    principal_point=[middle + 0.5 for middle in center],  # from the corner of the image
                    resolution=twin.camera.image_size[::-1],
                    camera_xyz=rr.ViewCoordinates.RDF,
                )
                stream.log(entity, rr.Transform3D(mat3x3=twin.pose[:3, :3].numpy()), pinhole)
                stream.log(entity, rr.Image(as_bytes(twin.remap(images[name]))).compress())
        panorama = depth.panorama(self.height)
        colors, _ = rgb_panorama(rig, images, self.height, panorama.depth.cpu())
        stream.log("color", rr.Image(as_bytes(colors)).compress())
        stream.log("depth", rr.DepthImage(panorama.measured.nan_to_num(0.0).cpu().numpy(), meter=1.0))
        sure = panorama.confidence.where(panorama.seen, 0.0)
        stream.log("confidence", rr.Image((255 * sure.clamp(0, 1)).round().byte().cpu().numpy()))
        cloud = depth.points()
        shades = (255 * cloud.colors.clamp(0, 1)).round().byte().cpu().numpy()
        stream.log("world/points", rr.Points3D((cloud.points.cpu() + offset).numpy(), colors=shades))

    def _twins_of(self, camera: Camera) -> list[PinholeTwin]:
        """``pinhole_twins``, made once: their tables are large, and cameras come again with each frame."""
        for earlier, twins in self._twins:
            if earlier.equals(camera):
                return twins
        self._twins.append((camera, pinhole_twins(camera)))
        return self._twins[-1][1]

    def close(self) -> None:
        """Finish the file."""
        self._stream.disconnect()
        self._writing.__exit__(None, None, None)
