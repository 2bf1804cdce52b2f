# SPDX-License-Identifier: Apache-2.0
"""Recordings for Rerun: what is logged says the frame, by a stand-in and by the package where it is installed."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sphericalvision import Predictor
from sphericalvision.cameras import ring_rig
from sphericalvision.capture import Depth
from sphericalvision.capture.rerun_log import RerunLog
from sphericalvision.core import ArgumentError
from sphericalvision.scenes import make_scene, render_rig

RIG = ring_rig(3, image_size=(32, 32))


@pytest.fixture(scope="module")
def depth() -> Depth:
    images = render_rig(make_scene("room", seed=1), RIG)
    return Predictor(RIG, method="semi_global", level=4, min_depth=0.5)(images)


class Stream:
    """Remembers what is logged, in place of a ``RecordingStream``."""

    def __init__(self, application: str) -> None:
        self.frame, self.logged, self.open = -1, {}, True

    def save(self, path: Path) -> None:
        self.path = path
        path.write_bytes(b"recording")

    def set_time(self, timeline: str, *, sequence: int) -> None:
        assert timeline == "frame"
        self.frame = sequence

    def log(self, entity: str, *values: Any, static: bool = False) -> None:
        assert self.open
        for value in values:
            kind = "pinhole" if isinstance(value, dict) else ""
            self.logged[entity + kind, None if static else self.frame] = value

    def disconnect(self) -> None:
        self.open = False


class Picture(np.ndarray):
    """An array that can be compressed."""

    def compress(self) -> Picture:
        return self


def test_a_recording_holds_cameras_images_depth_and_points(
    depth: Depth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_in = SimpleNamespace(
        RecordingStream=Stream,
        ViewCoordinates=SimpleNamespace(RDF="right, down, forward"),
        Transform3D=lambda translation=None, mat3x3=None: (translation, mat3x3),
        Pinhole=dict,
        Image=lambda pixels: pixels.view(Picture),
        DepthImage=lambda values, meter: values / meter,
        Points3D=lambda points, colors: (points, colors),
    )
    monkeypatch.setitem(sys.modules, "rerun", stand_in)
    with RerunLog(tmp_path / "out/depth.rrd", height=16) as log:
        log.add(0, depth)
        log.add(5, depth)
        assert not (tmp_path / "out/depth.rrd").exists()  # whole or not at all
        logged = log._stream.logged
    assert (tmp_path / "out/depth.rrd").read_bytes() == b"recording"
    assert logged.pop(("world", None)) == "right, down, forward"
    cameras = {f"world/{name}" for name in RIG.names}
    views = {f"{name}/{face}" for name in cameras for face in ("front", "right", "left", "up", "down")}
    entities = {*cameras, *views, "world/points", "color", "depth", "confidence"}
    entities |= {f"{name}/image" for name in cameras} | {f"{view}pinhole" for view in views}
    assert set(logged) == {(entity, frame) for entity in entities for frame in (0, 5)}
    translation, rotation = logged["world/cam2", 0]
    np.testing.assert_allclose(translation, RIG.positions[1], atol=1e-6)
    np.testing.assert_allclose(rotation @ [0, 0, 1], RIG.axes[1], atol=1e-6)
    assert logged["world/cam2/image", 0].shape == (32, 32, 3)
    right = logged["world/cam2/right", 0]
    pinhole = logged["world/cam2/rightpinhole", 0]
    assert right.shape == (*pinhole["resolution"][::-1], 3)
    assert pinhole["focal_length"] == pinhole["principal_point"]  # 90°, looking along its middle
    panorama = depth.panorama(16)
    np.testing.assert_allclose(
        logged["depth", 5][panorama.seen.numpy()], panorama.depth[panorama.seen], rtol=1e-5
    )
    assert (logged["depth", 5][~panorama.seen.numpy()] == 0).all()
    points, colors = logged["world/points", 0]
    assert len(points) == len(colors) == len(depth.points().points)


def test_rerun_itself_takes_it(depth: Depth, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    with RerunLog(tmp_path / "depth.rrd", height=16) as log:
        log.add(0, depth)
    recording = (tmp_path / "depth.rrd").read_bytes()
    assert recording[:3] == b"RRF"
    assert len(recording) > 5000


def test_that_it_is_not_installed_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ArgumentError, match="rerun-sdk"):
        RerunLog(tmp_path / "depth.rrd")
