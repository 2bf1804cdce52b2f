# SPDX-License-Identifier: Apache-2.0
"""A frame is done where every output has it in a file that is there; no file leaves the folder."""

from __future__ import annotations

import importlib.util
import json
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import pytest

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import Depth
from sphericalvision.capture.outputs import Outputs
from sphericalvision.capture.result_folder import Settings
from sphericalvision.capture.writers import OUTPUTS
from sphericalvision.core import FileFormatError
from tests.worlds import ball

FRAMES = ["7", 'a, "b"', "9"]
SEQUENCES = {
    "panorama_video": "panorama.mp4",
    "video": "depth.mp4",
    "timeline": "timeline.html",
    "rerun": "depth.rrd",
}
"""Outputs with one file for all frames, which is there once it is closed."""
FILES = {
    "panorama": "9_panorama.png",
    "depth": "9_color.png",
    "confidence": "9_confidence.png",
    "cloud": "9_points.ply",
    "glb": "9_points.glb",
    "mesh": "9_mesh.ply",
    "viewer": "9_viewer.html",
    "npz": "9_depth.npz",
    "splat": "9_splat/pinhole/transforms.json",
}
"""Output -> a file without which the third frame is not done."""


def depth_of(names: Sequence[str] = ("cam1", "cam2", "cam3")) -> Depth:
    rig = ring_rig(3, image_size=(16, 16))
    return ball(CameraRig(dict(zip(names, rig.cameras.values(), strict=True)), rig.world_from_camera))


def outputs_of(folder: Path, *names: str, go_on: bool = True, posed: bool = False) -> Outputs:
    if "rerun" in names and importlib.util.find_spec("rerun") is None:
        pytest.skip("needs rerun-sdk")
    return Outputs(folder, Settings(names, 16, near=1.0, go_on=go_on, posed=posed))


def write(outputs: Outputs, frames: list[str]) -> None:
    for frame in frames:
        outputs.write(frame, depth_of())


@pytest.mark.parametrize("output", OUTPUTS)
def test_frames_are_done_once_their_files_are(output: str, tmp_path: Path) -> None:
    outputs = outputs_of(tmp_path, output)
    assert outputs.remaining(FRAMES) == set(FRAMES)
    write(outputs, FRAMES[:2])
    if output != "fused":  # which is written when that takes little of the time
        killed = set(FRAMES if output in SEQUENCES else FRAMES[2:])
        assert outputs_of(tmp_path, output).remaining(FRAMES) == killed
    outputs.close()
    restarts = output in ("timeline", "rerun")
    assert outputs_of(tmp_path, output).remaining(FRAMES[:2]) == set()
    assert outputs_of(tmp_path, output).remaining(FRAMES) == set(FRAMES if restarts else FRAMES[2:])
    both = outputs_of(tmp_path, output, "npz").remaining(FRAMES[:2])
    assert both == (set() if output == "npz" else set(FRAMES[:2]))
    assert outputs_of(tmp_path, output, go_on=False).remaining(FRAMES) == set(FRAMES)


@pytest.mark.parametrize("output", [*FILES, *SEQUENCES])
def test_files_that_are_gone_are_made_again(output: str, tmp_path: Path) -> None:
    outputs = outputs_of(tmp_path, output)
    write(outputs, FRAMES)
    outputs.close()
    path = tmp_path / {**FILES, **SEQUENCES}[output]
    path.unlink()
    again = outputs_of(tmp_path, output)
    frames = again.remaining(FRAMES)
    assert frames == set(FRAMES if output in SEQUENCES else ["9"])
    write(again, sorted(frames))
    again.close()
    assert path.stat().st_size > 100
    assert outputs_of(tmp_path, output).remaining(FRAMES) == set()


@pytest.mark.parametrize("output", ["video", "panorama_video"])
def test_a_video_is_continued_by_a_part_with_the_frames_it_lacks(output: str, tmp_path: Path) -> None:
    before = None
    for names, frames in (([output], FRAMES[:2]), ([output, "npz"], FRAMES), ([output, "npz"], FRAMES)):
        outputs = outputs_of(tmp_path, *names)
        write(outputs, frames)
        outputs.close()
        first = (tmp_path / SEQUENCES[output]).read_bytes()
        assert before in (None, first)
        before = first
    parts = sorted(tmp_path.glob("*.mp4"))
    assert [path.stem.rpartition("_")[2] for path in parts] == [SEQUENCES[output][:-4], "2"]
    counts = [int(cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT)) for path in parts]
    assert counts == [2, 1]


def test_colours_are_those_of_the_first_frame_of_all_runs(tmp_path: Path) -> None:
    for number, nearest in enumerate((2.0, 5.0)):
        outputs = Outputs(tmp_path, Settings(["depth"], 16, go_on=True))
        depth = depth_of()
        outputs.write(str(number), replace(depth, network=depth.network.with_changes(min_depth=nearest)))
        outputs.close()
        if number == 0:
            near = outputs.results.near
    assert outputs.results.near == near
    fresh = Outputs(tmp_path, Settings(["depth"], 16))
    assert fresh.results.near is None


@pytest.mark.parametrize("output", ["panorama", "panorama_video"])
def test_seams_are_at_the_depth_of_what_two_cameras_see(output: str, tmp_path: Path) -> None:
    """The median of the first frame; a guess elsewhere has no part in it."""
    outputs, depth = outputs_of(tmp_path, output), depth_of()
    seen = depth.directions[:, 0] > 0.3
    for factor in (1.0, 2.0):
        index = (factor * depth.index).where(seen, 0.1)
        outputs.write(str(factor), replace(depth, index=index, seen=seen))
    (told,) = (sentence for sentence in outputs.described() if "seams" in sentence)
    assert f"{float(depth.depth.median()):.2f} m" in told
    outputs.close()


HOSTILE = ["../../out", "/etc/x", "..", "a\\..\\b", "~", "x\0y"]


@pytest.mark.parametrize("posed", [False, True])
def test_no_name_from_data_leaves_the_folder(tmp_path: Path, posed: bool) -> None:
    folder = tmp_path / "deep" / "er" / "out"
    names = [name for name in OUTPUTS if name != "rerun" or importlib.util.find_spec("rerun")]
    outputs = Outputs(folder, Settings(names, 16, near=1.0, posed=posed))
    for frame in HOSTILE[:: 1 if posed else 2]:
        outputs.write(frame, depth_of(["../../cam1", "/cam2", "c\\am3"]))
    outputs.close()
    assert [path.name for path in tmp_path.iterdir()] == ["deep"]
    assert [path.name for path in folder.parent.iterdir()] == ["out"]
    written = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert len(written) > 40
    assert all(path.resolve().is_relative_to(folder.resolve()) for path in written)


@pytest.mark.parametrize("name", ["../../victim.mp4", "pipe", "/dev/zero"])
def test_a_record_from_a_stranger_names_no_file(tmp_path: Path, name: str) -> None:
    """Names of files in it do not count, nothing behind a link or a pipe is read or written."""
    victim, folder = tmp_path / "victim.mp4", tmp_path / "deep" / "out"
    victim.write_bytes(b"mine")
    folder.mkdir(parents=True)
    os.mkfifo(folder / "pipe")
    os.symlink(victim, folder / "depth.mp4")
    line = {"output": "video", "part": 1, "frames": [], "files": {name: 1}, "file": name}
    (folder / "frames.jsonl").write_text(json.dumps(line) + "\n")
    outputs = outputs_of(folder, "video", "consistency")
    write(outputs, FRAMES)
    outputs.close()
    assert victim.read_bytes() == b"mine"


@pytest.mark.parametrize(
    "content",
    [b"\xff\n", b"[]\n", b"{}\n", b'{"near": "x"}\n', b'{"output": "video", "part": "x", "frames": []}\n'],
)
def test_a_damaged_record_is_an_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "frames.jsonl").write_bytes(content)
    with pytest.raises(FileFormatError, match=r"frames\.jsonl"):
        outputs_of(tmp_path, "video")
