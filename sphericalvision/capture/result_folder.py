# SPDX-License-Identifier: Apache-2.0
"""The folder of a run's results: settings, names of files, and which frames are in files of many frames."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from sphericalvision.capture.fusing import FusedCloud
from sphericalvision.capture.panoramas import Panoramas
from sphericalvision.core import FileFormatError
from sphericalvision.io.files import SEPARATORS, part_of_name, write_bytes

FUSED = "fused.npz"
"""Next to the fused cloud: the state that a continuation starts from."""
CUBE = 5.0
"""Side of the cubes of the fused cloud where none is given: so many steps between points at the nearest hypothesis."""
MAX_RECORD = 2**26
"""Bytes of ``frames.jsonl``: a million frames."""


class Settings(NamedTuple):
    """How results are written.

    Attributes:
        outputs: of ``OUTPUTS``.
        height: rows of panoramas.
        min_confidence: below which there are no points.
        voxel: side of the cubes of which each keeps one point, metres; of the fused cloud five times the
            distance between neighbouring points at the nearest hypothesis where it is not given.
        rate: frames a second of the video.
        near: metres, the red end of depth pictures; found in the first frame when not given.
        go_on: whether results that are there count as done.
        axes: ``(3, 3)`` that turns what ``.ply`` files hold into a robot's axes.
        posed: whether frames are of one world, as their poses say: one ``splat`` of all of them then, with the fused
            cloud; else one of each.
    """

    outputs: Sequence[str]
    height: int = 320
    min_confidence: float = 0.0
    voxel: float | None = None
    rate: float = 10.0
    near: float | None = None
    go_on: bool = False
    axes: Tensor | None = None
    posed: bool = False


class ResultFolder:
    """What the writers of a run have in common.

    A file of a frame tells by its name that the frame is done, as it appears when it is whole. Which frames a file of
    many frames has stands in ``frames.jsonl``: a line for each such file, and one with the colours of depth pictures.
    Files are named there by output and number alone, so that a record from elsewhere leads nowhere.

    Args:
        path: of the folder.
        settings: of the run.

    Attributes:
        near: metres, the red end of depth pictures; None before the first frame.
        fused: the cloud of all frames; None before one is asked for.

    Raises:
        FileFormatError: the record or the fused cloud that there is cannot be read.
    """

    def __init__(self, path: Path, settings: Settings) -> None:
        self.path, self.settings = path, settings
        self.near = settings.near
        self.fused: FusedCloud | None = None
        self._frames: dict[str, dict[int, list[str]]] = {}
        if settings.go_on and self.record.is_file():
            self._read()
        if settings.go_on and "fused" in settings.outputs and (path / FUSED).is_file():
            self.fused = FusedCloud.load(path / FUSED)

    @property
    def record(self) -> Path:
        """The file that says which frames are in files of many frames."""
        return self.path / "frames.jsonl"

    def frame_file(self, frame: str, name: str) -> Path:
        """The path of a file of one frame, whose name it begins with."""
        return self.path / (f"{part_of_name(frame, SEPARATORS)}_{name}" if frame else name)

    def views(self, depth: Panoramas) -> Panoramas:
        """The panoramas of a frame in the colours of the first one."""
        if self.near is None:
            self.near = depth.near
            self._write()
        depth.near = self.near
        return depth

    def frames(self, output: str) -> Mapping[int, list[str]]:
        """Part of an output -> the frames in its file."""
        return self._frames.get(output, {})

    def state(self, output: str, part: int, frames: Sequence[str]) -> None:
        """Record which frames the file of a part of an output has, once that is on the disk."""
        self._frames.setdefault(output, {})[part] = list(frames)
        self._write()

    def fuse(self, frame: str, views: Panoramas) -> FusedCloud:
        """The fused cloud with a frame added, unless it is in it already."""
        depth, settings = views.depth, self.settings
        if self.fused is None:
            spacing = math.sqrt(4 * math.pi / depth.index.numel()) * depth.min_depth
            self.fused = FusedCloud(settings.voxel or CUBE * spacing)
        points = views.points(settings.min_confidence)
        self.fused.add(frame, points, views.panorama, depth.rig.center, depth.rig.origin)
        return self.fused

    def _write(self) -> None:
        lines: list[dict[str, object]] = [] if self.near is None else [{"near": self.near}]
        for output, parts in self._frames.items():
            lines += ({"output": output, "part": part, "frames": names} for part, names in parts.items())
        write_bytes(self.record, "".join(f"{json.dumps(line)}\n" for line in lines).encode())

    def _read(self) -> None:
        try:
            if (size := self.record.stat().st_size) > MAX_RECORD:
                raise ValueError(f"it has {size:,} bytes")
            for text in self.record.read_text("utf-8").splitlines():
                line = json.loads(text)
                if "near" in line:
                    near = float(line["near"])
                    self.near = near if self.settings.near is None else self.settings.near
                else:
                    frames = [str(frame) for frame in line["frames"]]
                    self._frames.setdefault(str(line["output"]), {})[int(line["part"])] = frames
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise FileFormatError(
                f"{self.record}: is damaged ({type(error).__name__}: {error}); delete it, and all frames are made again"
            ) from None
