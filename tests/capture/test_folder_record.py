# SPDX-License-Identifier: Apache-2.0
"""A frame counts as done where every output has it, in files that are as they were written: outputs x damage."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest
import torch

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import Depth
from sphericalvision.capture.folder_record import RECORD, FolderRecord
from sphericalvision.capture.outputs import OUTPUTS, Outputs, Settings
from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.models import WinnerTakesAll

FRAMES = ["7", 'a, "b"', "9"]
FILES = {
    "panorama": "9_panorama.png",
    "panorama_video": "panorama.mp4",
    "depth": "9_color.png",
    "confidence": "9_confidence.png",
    "cloud": "9_points.ply",
    "glb": "9_points.glb",
    "mesh": "9_mesh.ply",
    "viewer": "9_viewer.html",
    "npz": "9_depth.npz",
    "splat": "9_splat/pinhole/transforms.json",
    "video": "depth.mp4",
    "timeline": "timeline.html",
    "rerun": "depth.rrd",
}
"""Output -> a file whose damage makes its frame unfinished."""
WHOLE = ("panorama_video", "video", "timeline", "rerun")
"""Outputs whose one file has all frames."""
DAMAGES: dict[str, Callable[[Path], object]] = {
    "gone": lambda path: path.unlink(),
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-1]),
    "of another run": lambda path: path.write_bytes(path.read_bytes()[::-1]),
}


@pytest.fixture
def depth() -> Depth:
    """Depth of 2 m all around."""
    rig: CameraRig = ring_rig(3, image_size=(16, 16))
    net = WinnerTakesAll(4, 8, min_depth=1.0, depth_coarsening=0)
    ones = torch.ones(net.grid.num_vertices)
    images = {name: torch.rand(3, *camera.image_size) for name, camera in rig.cameras.items()}
    return Depth(3.5 * ones, torch.linspace(0, 1, len(ones)), ones > 0, net, rig, images)


def outputs_of(folder: Path, *kinds: str, go_on: bool = True) -> Outputs:
    if "rerun" in kinds and importlib.util.find_spec("rerun") is None:
        pytest.skip("needs rerun-sdk")
    return Outputs(folder, Settings(kinds, 16, near=1.0, go_on=go_on))


@pytest.mark.parametrize("output", OUTPUTS)
def test_frames_are_done_once_their_files_are(output: str, depth: Depth, tmp_path: Path) -> None:
    """What was killed before it was closed is done where each frame has files of its own."""
    outputs = outputs_of(tmp_path, output)
    assert outputs.remaining(FRAMES) == set(FRAMES)
    for frame in FRAMES[:2]:
        outputs.write(frame, depth)
    if output != "fused":  # which is written when that takes little of the time
        assert outputs_of(tmp_path, output).remaining(FRAMES) == set(
            FRAMES if output in WHOLE else FRAMES[2:]
        )
    outputs.close()
    restarted = output in ("timeline", "rerun")
    assert outputs_of(tmp_path, output).remaining(FRAMES[:2]) == set()
    assert outputs_of(tmp_path, output).remaining(FRAMES) == set(FRAMES if restarted else FRAMES[2:])
    assert outputs_of(tmp_path, output, "npz").remaining(FRAMES[:2]) == (
        set() if output == "npz" else set(FRAMES[:2])
    )
    assert outputs_of(tmp_path, output, go_on=False).remaining(FRAMES) == set(FRAMES)


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("output", FILES)
def test_damaged_files_are_made_again(output: str, damage: str, depth: Depth, tmp_path: Path) -> None:
    outputs = outputs_of(tmp_path, output)
    for frame in FRAMES:
        outputs.write(frame, depth)
    outputs.close()
    path = tmp_path / FILES[output]
    DAMAGES[damage](path)
    again = outputs_of(tmp_path, output)
    frames = again.remaining(FRAMES)
    assert frames == set(FRAMES if output in WHOLE else ["9"])
    for frame in frames:
        again.write(frame, depth)
    again.close()
    assert path.stat().st_size > 100
    assert outputs_of(tmp_path, output).remaining(FRAMES) == set()


@pytest.mark.parametrize("output", ["video", "panorama_video"])
def test_a_video_has_each_frame_once(output: str, depth: Depth, tmp_path: Path) -> None:
    """Frames that another output lacks are written to that one alone."""
    for kinds in ([output], [output, "npz"], [output, "npz"]):
        outputs = outputs_of(tmp_path, *kinds)
        for frame in FRAMES:
            outputs.write(frame, depth)
        outputs.close()
    (path,) = tmp_path.glob("*.mp4")
    assert cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT) == len(FRAMES)


def test_results_of_another_basis_are_refused(tmp_path: Path) -> None:
    FolderRecord(tmp_path, {"rig": "a", "network": "n"}, True).add(["npz"], ["7"], [])
    assert list(FolderRecord(tmp_path, {"rig": "a", "network": "n"}, True).frames["npz"]) == ["7"]
    with pytest.raises(ArgumentError, match="results of another rig: what these files hold has changed"):
        FolderRecord(tmp_path, {"rig": "b", "network": "n"}, True)
    assert FolderRecord(tmp_path, {"rig": "b", "network": "n"}, False).frames == {}


def test_a_torn_line_is_one_frame_less_and_a_damaged_one_is_told(tmp_path: Path) -> None:
    record = FolderRecord(tmp_path, {}, True)
    for frame in FRAMES:
        record.add(["npz"], [frame], [])
    path = tmp_path / RECORD
    content = path.read_bytes()
    path.write_bytes(content[:-5])
    again = FolderRecord(tmp_path, {}, True)
    assert list(again.frames["npz"]) == FRAMES[:2]
    again.add(["npz"], FRAMES[2:], [])
    assert path.read_bytes() == content
    for damaged in (b"", b"[]\n", b"\xff\n", content.replace(b"frames", b"f"), content[40:]):
        path.write_bytes(damaged)
        with pytest.raises(FileFormatError, match=r"frames\.jsonl: is damaged .*; delete it"):
            FolderRecord(tmp_path, {}, True)
