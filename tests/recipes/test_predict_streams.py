# SPDX-License-Identifier: Apache-2.0
"""Prediction on videos, folders and live cameras: the frames that were asked for, whatever they come in."""

from __future__ import annotations

import math
import re
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sphericalvision.cameras import ring_rig
from sphericalvision.capture import Depth, calibrate_photometry
from sphericalvision.capture.estimating import ahead, ordered_map
from sphericalvision.capture.outputs import Outputs
from sphericalvision.capture.panoramas import Panoramas
from sphericalvision.capture.predictor import threads_kept
from sphericalvision.capture.preparation.preparation import Compensation
from sphericalvision.capture.result_folder import Settings
from sphericalvision.capture.sources.frames import Selection
from sphericalvision.capture.sources.joined_views import views_layout
from sphericalvision.capture.sources.opening import open_source, rig_for_images
from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.io.images import read_image, write_image
from sphericalvision.models import SemiGlobalSweep
from sphericalvision.recipes.app.captures import Capture
from sphericalvision.scenes import make_scene, render_rig
from tests.recipes.tiny import Run, typed, write_capture, write_streams

SIZE = (32, 40)
FRAMES = 7
RIG = ring_rig(4, image_size=SIZE)


def picture(frame: int, camera: int) -> np.ndarray:
    """A picture that tells frame and camera by its grey, which survives compression."""
    return np.full((*SIZE, 3), 20 + 30 * frame + 5 * camera, np.uint8)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """The same seven frames as videos of each camera, as videos of all, and as images."""
    folder = tmp_path / "capture"
    folder.mkdir()
    RIG.to_yaml(folder / "rig.yaml")
    for camera in range(4):
        write_streams(
            folder / f"videos/cam{camera + 1}.avi", [[picture(f, camera) for f in range(FRAMES)]], "mjpeg"
        )
        for frame in range(FRAMES):
            write_image(folder / f"images/cam{camera + 1}/{frame:03d}.png", picture(frame, camera))
    views = [[picture(frame, camera) for camera in range(4)] for frame in range(FRAMES)]
    write_streams(folder / "row.avi", [[np.concatenate(row, 1) for row in views]], "mjpeg")
    square = [np.concatenate([np.concatenate(row[:2], 1), np.concatenate(row[2:], 1)]) for row in views]
    write_streams(folder / "square.avi", [square], "mjpeg")
    return folder


def rig_words(capture: Path, *more: str) -> list[str]:
    """The capture's rig as it is calibrated, and more words of a prediction."""
    return [f"calibration={capture}/rig.yaml", "device=cpu", "align=false", *more]


def values(frame: object) -> list[float]:
    """Mean grey of each camera's picture, in the order of the rig."""
    images = frame.images  # type: ignore[attr-defined]
    return [float(torch.as_tensor(np.asarray(images[name])).float().mean()) for name in RIG.names]


@pytest.mark.parametrize("images", ["videos", "row.avi", "square.avi", "images"])
def test_folders_and_views_side_by_side_give_the_same_frames(capture: Path, images: str) -> None:
    source = open_source(str(capture / images), RIG)
    assert source.sizes() == dict.fromkeys(RIG.names, SIZE)
    scale = 255 if images == "images" else 1  # image files come as [0, 1]
    frames = list(source.frames(Selection(1, 6, 2), lambda name: int(name) != 3))
    assert [int(frame.name) for frame in frames] == [1, 5]
    for frame in frames:
        expected = [20 + 30 * int(frame.name) + 5 * camera for camera in range(4)]
        np.testing.assert_allclose(np.multiply(values(frame), scale), expected, atol=3)


def test_colours_of_videos_are_red_green_blue(tmp_path: Path) -> None:
    red = np.zeros((*SIZE, 3), np.uint8)
    red[..., 0] = 200
    write_streams(tmp_path / "all.avi", [[np.concatenate([red] * 4, 1)] * 2], "mjpeg")
    frame = next(iter(open_source(str(tmp_path / "all.avi"), RIG).frames(Selection(), lambda _: True)))
    assert frame.images is not None
    assert frame.images["cam2"][..., 0].mean() > 180
    assert frame.images["cam2"][..., 2].mean() < 30


def test_videos_are_not_turned(tmp_path: Path) -> None:
    """As image files: whatever the header says, here half a turn."""
    stored = np.zeros((*SIZE, 3), np.uint8)
    stored[:16] = 255
    path = tmp_path / "all.mp4"
    write_streams(path, [[np.concatenate([stored] * 4, 1)] * 2])
    content = bytearray(path.read_bytes())
    at = content.find(b"tkhd") + 8 + 20 + 16
    content[at : at + 36] = struct.pack(
        ">9i", -(1 << 16), 0, 0, 0, -(1 << 16), 0, 160 << 16, 32 << 16, 1 << 30
    )
    path.write_bytes(content)
    frame = open_source(str(path), RIG).samples()[0]
    assert frame.images is not None
    assert frame.images["cam3"][2].mean() > 200


def test_live_cameras_are_frames_without_an_end(
    capture: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Devices are videos that are opened by number."""
    opened = cv2.VideoCapture

    def device(which: int | str) -> cv2.VideoCapture:
        return opened(str(capture / f"videos/cam{which + 1}.avi") if isinstance(which, int) else which)

    monkeypatch.setattr(cv2, "VideoCapture", device)
    source = open_source("live:0,1,2,3", RIG)
    assert source.live
    assert source.sizes() == dict.fromkeys(RIG.names, SIZE)
    with pytest.raises(ArgumentError, match="masks: auto reads the frames before the first is predicted"):
        Capture(calibration="rig.yaml", images="live:0,1,2,3", masks="auto").restrict(source)
    assert source.names(Selection()) is None
    assert source.samples() == []
    frames = list(source.frames(Selection(0, 4, 2), lambda _: True))
    assert [int(frame.name) for frame in frames] == [0, 2]
    np.testing.assert_allclose(values(frames[1]), [80, 85, 90, 95], atol=3)
    with pytest.raises(ArgumentError, match="live:0,1,2,3"):
        open_source("live:0,1", RIG)


def test_what_cannot_be_opened_or_cut_is_named(capture: Path, tmp_path: Path) -> None:
    (tmp_path / "broken.mp4").write_bytes(b"no video")
    with pytest.raises(FileFormatError, match=r"broken\.mp4"):
        open_source(str(tmp_path / "broken.mp4"), RIG)
    with pytest.raises(FileNotFoundError, match="views of all cameras"):
        open_source(str(tmp_path / "none.mp4"), RIG)
    with pytest.raises(FileNotFoundError, match="no images or videos of all 4 cameras"):
        open_source(str(capture), RIG, leave_out=capture.glob("*.avi"))
    with pytest.raises(ArgumentError, match="4 views of the shape 40 x 32"):
        views_layout((32, 41), RIG)
    with pytest.raises(ArgumentError, match="4 views of the shape 40 x 32"):
        views_layout((641, 800), RIG)  # no two rows of whole pixels
    with pytest.raises(ArgumentError, match="start="):
        open_source(str(capture / "row.avi"), RIG, frames=[1])


def test_streams_of_one_file_are_the_cameras(tmp_path: Path) -> None:
    file = tmp_path / "VID.insv"
    write_streams(file, [[picture(0, camera)] * 2 for camera in range(4)])
    assert open_source(str(file), RIG, cameras=["cam3"]).labels == {"cam3": "stream 2"}
    with pytest.raises(ArgumentError, match=r"VID.insv has 4 video streams"):
        open_source(str(file), RIG.subset(["cam1", "cam2"]))


def test_a_file_of_two_lenses_is_a_panorama_in_one_command(run: Run, tmp_path: Path) -> None:
    """What a camera with two fisheyes back to back writes, and the same views as pictures: one panorama."""
    rig = ring_rig(2, 0.02, (128, 128), math.radians(200))
    images = render_rig(make_scene("room", seed=3), rig)
    frames = {name: (255 * image).byte().movedim(0, -1).numpy() for name, image in images.items()}
    write_capture(tmp_path, rig, images)
    write_streams(tmp_path / "VID.insv", [[frames[name]] * 2 for name in rig.names])
    words = typed("calibration=rig.yaml outputs=[panorama] height=64 level=3 method=semi_global align=false")
    printed = run("predict", *words, "images=VID.insv", "output=video")
    assert "Images: cam1 is stream 0, cam2 is stream 1." in printed
    run("predict", *words, "images={camera}/{frame}.png", "output=pictures")
    video, pictures = (
        read_image(next((tmp_path / folder).glob("*panorama.png"))) for folder in ("video", "pictures")
    )
    assert video.shape == (3, 64, 128)
    assert video.std() > 0.1
    assert (video - pictures).abs().mean() < 0.02  # what a codec loses
    printed = run("inspect", "calibration=rig.yaml", "images=VID.insv", "level=3", "output=seen")
    assert "cam2 is stream 1" in printed
    assert (tmp_path / "seen/angles_cam2.png").is_file()


def test_a_video_gets_its_name_when_it_is_whole(tmp_path: Path) -> None:
    """A limit on the size of files is like a full disk."""
    resource = pytest.importorskip("resource")
    net = SemiGlobalSweep(3, 8)
    index, ones = torch.rand(net.grid.num_vertices), torch.ones(net.grid.num_vertices)
    images = {name: torch.rand(3, *SIZE) for name in RIG.names}
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    for limit, number in ((limits[0], 4), (4096, 0)):
        outputs = Outputs(tmp_path / str(number), Settings(["video"], height=64))
        for frame in range(4):
            outputs.write(str(frame), Depth(8 * index.roll(frame), ones, ones > 0, net, RIG, images))
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limits[1]))
        try:
            with nullcontext() if number else pytest.raises(OSError, match=r"\d"):
                outputs.close()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [str(path.relative_to(tmp_path)) for path in sorted(tmp_path.rglob("*.*"))] == [
        "0/frames.jsonl",
        "4/depth.mp4",
        "4/frames.jsonl",
    ]
    picture = cv2.VideoCapture(str(tmp_path / "4/depth.mp4")).read()[1]
    middle = picture.shape[1] // 2
    assert 50 < picture[:64, middle - 60 : middle + 60].mean() < 200  # above, the colours of the images


def test_images_become_a_panorama_and_a_video_of_it(tmp_path: Path) -> None:
    """Cameras of one colour each: so are pictures and video, in front and behind."""
    net = SemiGlobalSweep(3, 8)
    ones = torch.ones(net.grid.num_vertices)
    shades = {name: (k + 1) / 5 for k, name in enumerate(RIG.names)}
    images = {name: torch.full((3, *SIZE), shade) for name, shade in shades.items()}
    outputs = Outputs(tmp_path, Settings(["panorama", "panorama_video"], height=32))
    for frame in ("0", "1"):
        outputs.write(frame, Depth(4 * ones, ones, ones > 0, net, RIG, images))
    outputs.close()
    names = ["0_panorama.png", "1_panorama.png", "panorama.mp4"]
    assert sorted(path.name for path in outputs.written) == names
    picture = cv2.imread(str(tmp_path / "0_panorama.png"))
    video = cv2.VideoCapture(str(tmp_path / "panorama.mp4"))
    shown = [video.read()[1] for _ in range(2)]
    assert picture.shape == shown[1].shape == (32, 64, 3)
    assert np.abs(picture.astype(int) - shown[1])[8:24].mean() < 6
    assert picture.min() >= 0.2 * 255 - 1
    assert picture.max() <= 0.8 * 255 + 1
    assert np.ptp(picture.astype(int)) > 60
    dim = {name: torch.full((3, *SIZE), 0.4 + 0.05 * k) for k, name in enumerate(RIG.names)}
    even = Compensation({}, calibrate_photometry(RIG, dim))
    uneven, evened = (
        Panoramas(Depth(4 * ones, ones, ones > 0, net, RIG, dim, light), 32).stitched[8:24].std()
        for light in ((), (even,))
    )
    assert evened < 0.3 * uneven


def test_a_resized_capture_has_a_resized_rig() -> None:
    half = rig_for_images(RIG, dict.fromkeys(RIG.names, (16, 20)))
    assert half.cameras["cam3"].image_size == (16, 20)
    assert rig_for_images(RIG, dict.fromkeys(RIG.names, SIZE)) is RIG
    assert rig_for_images(RIG, {"cam1": (16, 30)}) is RIG  # a part of it, or another camera


def test_a_video_becomes_a_video(run: Run, capture: Path, weights: Path, tmp_path: Path) -> None:
    words = rig_words(capture, f"checkpoint={weights}", "height=32", "min_depth=scene")
    printed = run("predict", *words, f"images={capture}/row.avi", "output=out", "every=3")
    video = cv2.VideoCapture(str(tmp_path / "out/depth.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 3
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(5 / 3, abs=0.01)
    assert video.read()[1].shape[0] > 64  # colours above depth and its scale
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "config.yaml",
        "depth.mp4",
        "frames.jsonl",
    ]
    assert re.search(
        r"3 frame\(s\) in [\d.]+ s: [\d.]+ frames/s, the network busy \d+ % of the time", printed
    )


def test_weights_that_ship_serve_the_level_of_a_preset_and_are_named(
    run: Run, capture: Path, weights: Path, tmp_path: Path
) -> None:
    """One level coarser, and half as high."""
    words = rig_words(capture, f"images={capture}/images", "stop=1", "preset=fast", "outputs=[npz]")
    for level, more in ((5, ()), (3, (f"checkpoint={weights}",))):
        printed = run("predict", *words, *more, f"output=out{level}")
        assert ("weights refinedsweepnet" in printed) == (not more)
        with np.load(tmp_path / f"out{level}/000_depth.npz") as arrays:
            assert arrays["depth_panorama"].shape == (160, 320)
            assert len(arrays["index"]) == 10 * 4**level + 2


def test_images_of_another_size_are_told(run: Run, capture: Path, weights: Path, tmp_path: Path) -> None:
    for path in (capture / "images").glob("*/*.png"):
        write_image(path, read_image(path)[:, ::2, ::2])
    words = rig_words(capture, f"checkpoint={weights}", "stop=1", "height=16")
    assert "images of cam1 have 20 x 16 pixels (width x height), the calibration is for 40 x 32" in (
        run("predict", *words, f"images={capture}/images", "output=out")
    )
    assert (tmp_path / "out/000_depth.npz").is_file()


def test_reading_ahead_is_bounded_keeps_order_and_hands_errors_on() -> None:
    taken = []

    def numbers() -> Iterator[int]:
        for number in range(100):
            taken.append(number)
            yield number
        raise ValueError("damaged")

    items = ahead(numbers(), most=2)
    assert next(items) == 0
    time.sleep(0.05)
    assert len(taken) <= 5  # one given, two waiting, one in the hand
    with pytest.raises(ValueError, match="damaged"):
        list(items)
    assert taken == list(range(100))
    stopped = ahead(numbers(), most=2)
    next(stopped)
    stopped.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "reading ahead"]


def test_live_frames_that_nobody_took_make_room() -> None:
    ready = threading.Event()

    def numbers() -> Iterator[int]:
        yield from range(20)
        ready.set()

    items = ahead(numbers(), most=2, newest=True)
    assert next(items) == 0
    assert ready.wait(20)
    assert list(items)[-1] == 19


def test_side_by_side_work_overlaps_keeps_order_and_ends_with_the_first_error() -> None:
    both = threading.Barrier(2, timeout=20)  # broken, and an error, unless two are at work at once
    seen: list[int] = []

    def work(number: int) -> int:
        if number == 7:
            raise ValueError("damaged")
        both.wait()
        seen.append(torch.get_num_threads())
        return number

    with threads_kept() as before:
        assert list(ordered_map(work, range(6), workers=2)) == list(range(6))
        assert set(seen) == {1}
    assert torch.get_num_threads() == before
    results = ordered_map(work, [0, 1, 7, 9], workers=2)
    assert [next(results), next(results)] == [0, 1]
    both.abort()
    for failing in (results, ordered_map(work, [7, *range(50)], workers=1, waiting=1, finish=True)):
        with pytest.raises(ValueError, match="damaged"):
            next(failing)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("ordered map")]
