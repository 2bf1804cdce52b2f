# SPDX-License-Identifier: Apache-2.0
"""Laws of all sources of frames: a frame is one moment, an image of each camera, and what is left out is counted."""

from __future__ import annotations

import itertools
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from functools import partial
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from sphericalvision.cameras import CameraRig, PinholeCamera, ring_rig
from sphericalvision.capture.sources.frames import Frame, Selection, Source
from sphericalvision.capture.sources.moments import Clock, pair_moments
from sphericalvision.capture.sources.opening import open_source, rig_with_masks
from sphericalvision.core import ArgumentError, FileFormatError, MissingFileError
from sphericalvision.io.images import write_image
from tests.capture.bags import write_bag

SIZE = (32, 48)
RIG = ring_rig(3, image_size=SIZE)
STEP = 0.1
"""Seconds between moments; cameras are 2 ms apart."""
Moments = Mapping[str, Sequence[int]]
Writer = Callable[[Path, Moments], str]
EVERYTHING: Moments = dict.fromkeys(RIG.names, range(10))
LOST: dict[str, Moments] = {
    "nothing": EVERYTHING,
    "the beginning": EVERYTHING | {"cam2": range(3, 10)},
    "the beginning of the first": EVERYTHING | {"cam1": range(2, 10)},
    "the end": EVERYTHING | {"cam3": range(7)},
    "here and there": {
        "cam1": [0, 1, 2, 4, 5, 6, 7, 8, 9],
        "cam2": [0, 1, 2, 3, 4, 5, 8, 9],
        "cam3": range(1, 9),
    },
}
"""Moments of each camera's images, where some were lost on the way."""


def picture(moment: int) -> np.ndarray:
    """A picture that tells its moment by its grey, which survives compression."""
    return np.full((*SIZE, 3), 20 + 20 * moment, np.uint8)


def moments_of(frame: Frame) -> set[int]:
    """The moments that the images of a frame show."""
    assert frame.images is not None
    greys = [float(torch.as_tensor(np.asarray(image)).double().mean()) for image in frame.images.values()]
    return {round((grey * (255 if grey <= 1 else 1) - 20) / 20) for grey in greys}


def seconds(camera: str, moment: int) -> float:
    return STEP * moment + 0.002 * RIG.names.index(camera)


def as_files(folder: Path, moments: Moments) -> str:
    """Image files called by their times in nanoseconds."""
    for camera, own in moments.items():
        for moment in own:
            time = 1_700_000_000 * 10**9 + round(seconds(camera, moment) * 1e9)
            write_image(folder / f"{camera}/{time}.png", picture(moment))
    return f"{folder}/{{camera}}/{{frame}}.png"


def as_files_named(folder: Path, names: Sequence[str]) -> str:
    """A picture of each name for every camera."""
    for camera in RIG.names:
        for name in names:
            write_image(folder / camera / f"{name}.png", picture(1))
    return f"{folder}/{{camera}}/{{frame}}.png"


def as_counted_files(folder: Path, moments: Moments) -> str:
    """Image files called by the number of their moment."""
    for camera, own in moments.items():
        for moment in own:
            write_image(folder / f"{camera}/{moment}.png", picture(moment))
    return f"{folder}/{{camera}}/{{frame}}.png"


def as_listed_files(folder: Path, moments: Moments, listing: str) -> str:
    """Image files called by their numbers in the order of each camera, with a table of their times next to them."""
    together, milliseconds = ["frame,camera,time"], {}
    for camera, own in moments.items():
        heads = {"times.csv": "frame,time", "timecodes.txt": "# timecode format v2"}
        lines = [heads.get(listing, "# times")]
        for number, moment in enumerate(own):
            time = 1_700_000_000 * 10**9 + round(seconds(camera, moment) * 1e9)
            write_image(folder / f"{camera}/data/{number:06d}.png", picture(moment))
            write_image(folder / f"{camera}/{number:06d}.png", picture(moment))
            together.append(f"{number},{camera},{time / 1e9:.9f}")
            milliseconds.setdefault(number, {})[camera] = f"{time / 1e6 % 1e7:.3f}"
            date = f"2023-11-14 22:13:{20 + (time // 10**9) % 40:02d}.{time % 10**9:09d}"
            columns = {
                "data.csv": f"{time},{number:06d}.png",
                "times.txt": f"{number:05d} {time / 1e9:.9f} 3.0",
                "times.csv": f"{number},{time / 1e9:.9f}",
                "timecodes.txt": f"{time / 1e6 % 1e7:.3f}",
            }
            lines.append(columns.get(listing, date))
        (folder / camera / listing).write_text("\n".join(lines))
    if listing == "stamps.csv":  # a column of each camera
        rows = [",".join((str(n), *(row.get(c, "") for c in moments))) for n, row in milliseconds.items()]
        together = [",".join(("frame", *(f"{camera} [ms]" for camera in moments))), *rows]
    if listing in ("metadata.csv", "stamps.csv"):
        (folder / listing).write_text("\n".join(together))
        for camera in moments:
            (folder / camera / listing).unlink()
    return f"{folder}/{{camera}}/{'' if listing in ('metadata.csv', 'stamps.csv') else 'data/'}{{frame}}.png"


def write_streams(path: Path, streams: Sequence[tuple[str, Sequence[int]]], is_steady: bool = False) -> None:
    """A video with a stream for each camera, whose pictures have the times of their moments; in AVI whole steps."""
    format, codec, unit = {
        ".avi": ("avi", "mjpeg", Fraction(1, 10)),
        ".mkv": ("matroska", "mpeg4", Fraction(1, 1000)),
    }.get(path.suffix, ("mp4", "mpeg4", Fraction(1, 1000)))
    with av.open(str(path), "w", format=format) as file:
        targets = []
        for camera, _ in streams:
            stream = file.add_stream(codec, rate=10)
            stream.width, stream.height, stream.metadata["title"] = SIZE[1], SIZE[0], camera
            stream.metadata["handler_name"] = camera
            stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
            stream.codec_context.time_base = unit
            stream.bit_rate, stream.codec_context.gop_size = 8_000_000, 4
            targets.append(stream)
        for moment in range(10):
            for (camera, own), target in zip(streams, targets, strict=True):
                if moment in own:
                    image = av.VideoFrame.from_ndarray(picture(moment), format="rgb24")
                    time = seconds(camera, own.index(moment) if is_steady else moment)
                    image.pts, image.time_base = round(time / unit), unit
                    file.mux(target.encode(image))
        for target in targets:
            file.mux(target.encode(None))


def as_videos(folder: Path, moments: Moments) -> str:
    folder.mkdir()
    for camera, own in moments.items():
        write_streams(folder / f"{camera}.mp4", [(camera, own)])
    return f"{folder}/{{camera}}.mp4"


def as_listed_videos(folder: Path, moments: Moments) -> str:
    """Videos whose pictures follow at a steady rate, with a table of the times when each was taken."""
    folder.mkdir()
    for camera, own in moments.items():
        write_streams(folder / f"{camera}.mp4", [(camera, own)], is_steady=True)
        lines = [f"{number},{1.7e9 + seconds(camera, moment):.6f}" for number, moment in enumerate(own)]
        (folder / f"{camera}.csv").write_text("\n".join(["frame,timestamp", *lines]))
    return f"{folder}/{{camera}}.mp4"


def as_streams(folder: Path, moments: Moments) -> str:
    folder.mkdir()
    write_streams(folder / "all.insv", list(moments.items()))
    return str(folder / "all.insv")


@pytest.mark.parametrize("suffix", [".mkv", ".mp4"])
def test_streams_are_of_the_cameras_that_they_are_called_by(tmp_path: Path, suffix: str) -> None:
    write_streams(tmp_path / f"a{suffix}", [(camera, [1]) for camera in ("cam3", "cam1", "cam2")])
    source, _ = opened(str(tmp_path / f"a{suffix}"))
    assert source.labels == {"cam1": "stream 1", "cam2": "stream 2", "cam3": "stream 0"}


def as_bag(folder: Path, moments: Moments, stamped: bool = True, received: bool = True) -> str:
    """A bag; without stamps its own times tell, without its own the stamps do."""
    messages = []
    for camera, own in moments.items():
        for moment in own:
            time = 1_700_000_000 * 10**9 + round(seconds(camera, moment) * 1e9)
            stamp, coarse = (time if stamped else 0), time // 10**9 * 10**9
            messages.append(
                (f"/{camera}/image_raw", stamp, time + 3_000_000 if received else coarse, picture(moment))
            )
    return str(write_bag(folder, sorted(messages, key=lambda message: message[2])))


SOURCES: dict[str, Writer] = {
    "files called by time": as_files,
    "files called by number": as_counted_files,
    **{
        f"files that {name} lists": partial(as_listed_files, listing=name)
        for name in (
            *("data.csv", "timestamps.txt", "times.txt", "times.csv", "metadata.csv"),
            *("timecodes.txt", "stamps.csv"),
        )
    },
    "videos": as_videos,
    "videos of a steady rate that tables list": as_listed_videos,
    "streams": as_streams,
    "a bag": as_bag,
    "a bag without stamps": lambda folder, moments: as_bag(folder, moments, stamped=False),
    "a bag of coarse times": lambda folder, moments: as_bag(folder, moments, received=False),
}


def opened(images: str, rig: CameraRig = RIG, **keys: object) -> tuple[Source, list[str]]:
    """A source, and what was said when it was opened."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        source = open_source(images, rig, **keys)  # type: ignore[arg-type]
    return source, [str(warning.message) for warning in caught]


@pytest.mark.parametrize("lost", LOST)
@pytest.mark.parametrize("write", SOURCES.values(), ids=SOURCES)
def test_a_frame_is_one_moment_whatever_was_lost(tmp_path: Path, write: Writer, lost: str) -> None:
    """And what is left out is counted, camera by camera; nothing is said where nothing is."""
    moments = LOST[lost]
    source, told = opened(write(tmp_path / "capture", moments))
    common = sorted(set.intersection(*map(set, moments.values())))
    frames = list(source.frames(Selection(), lambda _: True))
    assert [moments_of(frame) for frame in frames] == [{moment} for moment in common]
    assert source.names(Selection()) == [frame.name for frame in frames]
    counts = {camera: len(own) - len(common) for camera, own in moments.items()}
    sentence = " ".join(source.notes)
    for camera, count in counts.items():
        assert (f"{count} of {len(moments[camera])} of {camera} " in sentence) == (count > 0)
    assert set(source.notes) <= set(told)
    assert sum("left out" in note for note in source.notes) == (lost != "nothing")
    assert [moments_of(frame) for frame in source.samples()] == [
        {common[position]} for position in (0, len(common) // 2, -1)
    ]
    times = source.times()
    if times is not None:
        np.testing.assert_allclose(times, STEP * np.subtract(common, common[0]), atol=1e-3)


@pytest.mark.parametrize("write", SOURCES.values(), ids=SOURCES)
def test_selected_and_wanted_frames_are_those_of_all(tmp_path: Path, write: Writer) -> None:
    source, _ = opened(write(tmp_path / "capture", EVERYTHING), cameras=["cam3", "cam1"])
    names = source.names(Selection(1, 9, 3))
    assert names is not None
    assert len(names) == 3
    frames = list(source.frames(Selection(1, 9, 3), lambda name: name != names[1]))
    assert [(frame.name, moments_of(frame)) for frame in frames] == [(names[0], {1}), (names[2], {7})]
    assert list(frames[0].images or {}) == ["cam3", "cam1"]
    assert source.sizes() == dict.fromkeys(["cam3", "cam1"], SIZE)
    with pytest.raises(ArgumentError, match="start=12"):
        source.names(Selection(12))


@pytest.mark.parametrize("lines", [-1, 0, 1])
@pytest.mark.parametrize("first", [0, 1])
def test_lines_of_tables_are_counted_alike_for_all_cameras(tmp_path: Path, first: int, lines: int) -> None:
    """Also where one has a line more or fewer than images, as of a recorder that was killed."""
    own = dict.fromkeys(RIG.names, range(12)) | {"cam2": [0, 1, 2, *range(4, 12)]}
    images = as_listed_files(tmp_path, own, "timestamps.txt")
    for file in sorted(tmp_path.glob("*/data/*.png"), reverse=True):
        file.rename(file.with_name(f"{int(file.stem) + first:06d}.png"))
    table = tmp_path / "cam2/timestamps.txt"
    rows = [*table.read_text().splitlines(), "2023-11-14 22:13:22.000000000"]
    table.write_text("\n".join(rows[: len(rows) + lines - 1]))
    frames = opened(images)[0].frames(Selection(), lambda _: True)
    assert [moments_of(frame) for frame in frames] == [{m} for m in own["cam2"]][: 11 + min(lines, 0)]


@pytest.mark.parametrize("content", [None, "2023-11-14 22:13:20.000000000\n", "22:13:20\n" * 10])
def test_times_beside_images_of_which_some_are_missing_do_not_count(
    tmp_path: Path, content: str | None
) -> None:
    images = as_listed_files(tmp_path, EVERYTHING, "timestamps.txt")
    (tmp_path / "cam2/timestamps.txt").unlink()
    if content:
        (tmp_path / "cam2/timestamps.txt").write_text(content)
    source, told = opened(images)
    assert len(source.names(Selection()) or ()) == 10
    assert [("of cam2 have no time" in sentence) for sentence in told] == [True]


@pytest.mark.parametrize("write", [as_files, as_videos, as_streams, as_bag])
def test_what_keeps_images_apart_is_told(tmp_path: Path, write: Writer) -> None:
    """Cameras are 2 and 4 ms apart."""
    images = write(tmp_path / "capture", EVERYTHING)
    with pytest.raises(
        MissingFileError, match=r"cam1: 10, .* are 0\.002 to 0\.004 s away; tolerance is 0\.001"
    ):
        open_source(images, RIG, tolerance=0.001)
    source, _ = opened(images)
    assert re.search(r"^paired by .*, 4 ms apart at most$", source.pairing)


def times(*values: float | None) -> dict[str, float | None]:
    return {str(number): value for number, value in enumerate(values)}


CLOCKS: dict[str, tuple[dict[str, float | None], int | None]] = {
    "whole": (times(5.0, 6.0, 7.0, 8.0), 0),
    "all zero": (times(0.0, 0.0, 0.0, 0.0), 1),
    "equal by halves": (times(5.0, 5.0, 7.0, 7.0), 1),
    "half missing": (times(5.0, None, 7.0, None), 1),
    "none": (times(None, None, None, None), 1),
    "of another epoch": (times(1e9, 1e9 + 1, 1e9 + 2, 1e9 + 3), 1),
}


@pytest.mark.parametrize(("second", "expected"), CLOCKS.values(), ids=CLOCKS)
def test_the_first_clock_that_tells_counts_and_it_is_said_which(
    second: dict[str, float | None], expected: int | None
) -> None:
    images = {camera: {str(number): number for number in range(4)} for camera in ("left", "right")}
    good = Clock("good", dict.fromkeys(images, times(1.0, 2.0, 3.0, 4.0)))
    moments = pair_moments(
        images, [Clock("doubtful", {"left": times(5.0, 6.0, 7.0, 8.0), "right": second}), good]
    )
    assert moments.clock == expected
    assert [frame["left"] == frame["right"] for frame in moments.frames.values()] == [True] * 4
    assert [("doubtful" in warning, "good count" in warning) for warning in moments.warnings] == (
        [(True, True)] if expected else []
    )
    alone = pair_moments(
        images, [Clock("doubtful", {"left": second, "right": second})], names="their numbers"
    )
    assert (alone.clock is None) == (expected == 1 and second != CLOCKS["of another epoch"][0])
    assert len(alone.frames) == 4


def test_a_clock_by_which_two_cameras_never_run_together_does_not_tell() -> None:
    """Whatever others span: one ends before another begins."""
    starts = {"left": (0.0, 30.0), "right": (5.0, 1.0), "top": (20.0, 1.0)}
    images = {camera: {str(number): number for number in range(4)} for camera in starts}
    doubtful = {
        camera: times(*(start + step * k for k in range(4))) for camera, (start, step) in starts.items()
    }
    good = Clock("good", dict.fromkeys(images, times(1.0, 2.0, 3.0, 4.0)))
    assert pair_moments(images, [Clock("doubtful", doubtful), good]).clock == 1


def test_a_lost_stamp_loses_its_image_alone() -> None:
    images = {camera: {str(number): number for number in range(20)} for camera in ("left", "right")}
    whole = times(*map(float, range(20)))
    for fault in (None, 3.0):
        clock = Clock("stamps", {"left": whole, "right": whole | {"7": fault}})
        moments = pair_moments(images, [clock])
        assert sorted(map(int, moments.frames)) == [n for n in range(20) if n != 7]
        assert "1 of 20 of left (7 first), 1 of 20 of right (7 first)" in moments.warnings[0]


def test_no_image_is_in_two_moments_however_wide_the_tolerance() -> None:
    images = {"left": {"0": 0, "1": 1}, "right": {"0": 0}}
    moments = pair_moments(
        images, [Clock("names", {"left": times(0.0, 0.1), "right": times(0.09)})], tolerance=1.0
    )
    assert moments.frames == {"1": {"left": 1, "right": 0}}


DAMAGED: dict[str, Callable[[Path], str]] = {}


def damaged(write: Callable[[Path], str]) -> Callable[[Path], str]:
    DAMAGED[write.__name__.removeprefix("_")] = write
    return write


@damaged
def _files(folder: Path) -> str:
    images = as_counted_files(folder, EVERYTHING)
    (folder / "cam2/4.png").write_bytes(b"no picture")
    return images


@damaged
def _video(folder: Path) -> str:
    images = as_videos(folder, EVERYTHING)
    write_streams(folder / "cam2.avi", [("cam2", range(10))])
    content = bytearray((folder / "cam2.avi").read_bytes())
    start = [match.start() for match in re.finditer(b"00dc", content)][5] + 8  # after one in the header
    size = int.from_bytes(content[start - 4 : start], "little")
    content[start : start + size] = bytes(size)
    (folder / "cam2.mp4").write_bytes(content)
    return images


@damaged
def _bag(folder: Path) -> str:
    messages = []
    for camera in RIG.names:
        for moment in range(10):
            time = 1_700_000_000 * 10**9 + moment * 10**8
            image = picture(moment)[:3] if (camera, moment) == ("cam2", 4) else picture(moment)
            messages.append((f"/{camera}/image_raw", time, time, image))
    return str(write_bag(folder, messages, size=SIZE))


@pytest.mark.parametrize("write", DAMAGED.values(), ids=DAMAGED)
def test_a_damaged_image_is_one_frame_that_says_why(tmp_path: Path, write: Callable[[Path], str]) -> None:
    source, _ = opened(write(tmp_path / "capture"))
    frames = list(source.frames(Selection(), lambda _: True))
    assert [frame.images is None for frame in frames] == [number == 4 for number in range(10)]
    assert isinstance(frames[4].error, FileFormatError)
    assert "damaged" in str(frames[4].error)


CANDIDATES = {  # what lies in a folder, and what of it is meant; None where that cannot be told
    "previews": (["{camera}.MP4", "{camera}.LRV"], ".MP4"),
    "previews alone": (["{camera}.LRV"], ".LRV"),
    "previews of another name": (["VID_1.insv", "LRV_1.insv"], "VID_1"),
    "thumbnails": (["{camera}/1.png", "{camera}/1.jpg"], None),
    "images and their depth": (["{camera}/1.png", "{camera}/1_depth.png"], None),
    "images and thumbnails": (["{camera}/1.png", "{camera}/thumb_1.png"], None),
    "images and depth of times": (["{camera}/1700000000.1.png", "{camera}/depth-1700000000.1.png"], None),
    "numbers with and without zeros": (["{camera}/1.png", "{camera}/001.png"], None),
    "one camera's other pictures": (["{camera}/1.jpg", "cam1/1.png"], ".jpg"),
    "numbers in front": (["1_{camera}.png"], "1_"),
    "names that are no layout": (["{camera}_1.png", "{camera}-1.png"], "_1"),
    "another way to write a suffix": (["{camera}/1.jpg", "cam1/2.JPG"], ".jpg"),
    "pictures next to folders of them": (["{camera}/1.png", "{camera}_1.png"], None),
    "two videos": (["a.mp4", "b.mp4"], None),
    "a video and pictures of it": (["{camera}.mp4", "{camera}/1.png"], None),
    "a GoPro's videos": (["{camera}.360"], ".360"),
    "a camcorder's videos": (["{camera}.MTS"], ".MTS"),
    "images and the bag that they are of": (["{camera}/1.png", "run.bag"], None),
    "EuRoC's folders": (["{camera}/data/1.png"], "data"),
    "KITTI's folders": (["image_0{camera[3]}/data/1.png"], "data"),
    "Insta360's pictures": (["IMG_1.insp", "IMG_2.insp"], ".insp"),
}


@pytest.mark.parametrize(("names", "expected"), CANDIDATES.values(), ids=CANDIDATES)
def test_of_two_candidates_none_is_taken_by_the_alphabet(
    tmp_path: Path, names: list[str], expected: str | None
) -> None:
    for name in names:
        for camera in RIG.names if "{camera" in name else [""]:
            path = tmp_path / name.format(camera=camera)
            path.parent.mkdir(parents=True, exist_ok=True)
            joined = np.concatenate([picture(1)] * (1 if camera else 3), 1)
            if path.suffix in (".png", ".jpg", ".JPG", ".insp"):
                path.write_bytes(
                    cv2.imencode(".png" if path.suffix == ".png" else ".jpg", joined)[1].tobytes()
                )
            elif camera:
                write_streams(path, [(camera, [1])])
            else:
                write_streams(path, [(camera, [1]) for camera in RIG.names])
    if expected is None:
        with pytest.raises(ArgumentError, match="several kinds") as refused:
            open_source(str(tmp_path), RIG)
        assert all(Path(name).suffix in str(refused.value) for name in names)
        return
    source, told = opened(str(tmp_path))
    assert moments_of(next(source.frames(Selection(), lambda _: True))) == {1}
    assert [("previews" in sentence) for sentence in told] == [True] * (
        len(names) == 2 and ".insp" not in expected
    )
    if streams := getattr(source, "streams", {}):
        assert all(expected in stream.file.name for stream in streams.values())


@pytest.mark.parametrize(
    ("names", "is_doubtful"),
    [
        (("Depth1", "Image1"), True),
        (("1", "1 (1)"), True),
        (("1", "1@2"), True),
        (("a_1", "b_1"), True),
        (("1", "latest"), True),
        (("a_1", "a_2"), False),
        (("1.5", "-1.5"), False),
        (("12", "12.5"), False),
        (("day", "night"), False),
    ],
)
def test_names_that_may_be_two_kinds_of_files_are_asked_about(
    tmp_path: Path, names: tuple[str, str], is_doubtful: bool
) -> None:
    images = as_files_named(tmp_path, names)
    source, told = opened(images)
    assert len(source.names(Selection()) or ()) == 2
    assert [all(name in sentence for name in names) for sentence in told] == [True] * is_doubtful
    frames = list(names)
    assert not opened(images, frames=frames)[1]  # who names frames has chosen


@pytest.mark.parametrize("start", ["rear-", "IMG_", ""])
def test_a_word_of_all_frames_may_be_of_another_camera(tmp_path: Path, start: str) -> None:
    for name, frame in itertools.product(RIG.names, ("1", "2") if start else ("rear_1", "mid_2")):
        write_image(tmp_path / f"{name}_{start}{frame}.png", picture(1))
    images = str(tmp_path)
    if start == "rear-":
        images = f"{tmp_path}/{{camera}}_rear-{{frame:01d}}.png"
        with pytest.raises(ArgumentError, match=f"if rear is a part of its name.*{re.escape(images)}"):
            open_source(str(tmp_path), RIG)
    assert len(opened(images)[0].names(Selection()) or ()) == 2


@pytest.mark.parametrize(
    ("digits", "expected"), [("01d", ["1", "2"]), ("03d", ["001"]), ("02d", ["001", "1", "2"])]
)
def test_a_width_chooses_between_numbers_with_and_without_zeros(
    tmp_path: Path, digits: str, expected: list[str]
) -> None:
    images = as_files_named(tmp_path, ["1", "2", "001"]).replace("{frame", f"{{frame:{digits}")
    if len(expected) == 3:  # none is of this width
        with pytest.raises(ArgumentError, match="several kinds"):
            open_source(images, RIG)
    else:
        assert opened(images)[0].names(Selection()) == expected


def test_a_folder_of_each_moment_is_none_of_a_camera(tmp_path: Path) -> None:
    for moment in range(1, 5):
        for camera in RIG.names:
            write_image(tmp_path / f"{moment:04d}/{camera}.png", picture(moment))
    frames = opened(str(tmp_path))[0].frames(Selection(), lambda _: True)
    assert list(map(moments_of, frames)) == [{1}, {2}, {3}, {4}]


@pytest.mark.parametrize("moments", [3, 4])
def test_numbers_alone_tell_cameras_where_these_have_all_files(tmp_path: Path, moments: int) -> None:
    for moment, camera in itertools.product(range(1, moments + 1), range(1, 4)):
        write_image(tmp_path / f"{moment:04d}_{camera}.png", picture(moment))
    if moments == len(RIG.names):
        with pytest.raises(ArgumentError, match=r"{camera}_{frame}\.png, .*{frame}_{camera}\.png; name one"):
            open_source(str(tmp_path), RIG)
    else:
        frames = opened(str(tmp_path))[0].frames(Selection(), lambda _: True)
        assert list(map(moments_of, frames)) == [{1}, {2}, {3}, {4}]


@pytest.mark.parametrize("target", ["nowhere.png", "2.png"])
def test_a_link_to_nothing_is_a_frame_that_cannot_be_read(tmp_path: Path, target: str) -> None:
    images = as_files_named(tmp_path, ["1", "2"])
    (tmp_path / "cam1/2.png").unlink()
    (tmp_path / "cam1/2.png").symlink_to(target)
    frames = list(open_source(images, RIG).frames(Selection(), lambda _: True))
    assert ["2.png" in str(frame.error) for frame in frames] == [False, True]


@pytest.mark.parametrize(
    ("key", "begins", "is_told"),
    [
        ("timecode", ("10:00:00:00", "10:00:02:00"), True),
        ("timecode", ("10:00:00:00", "10:00:00:00"), False),
        ("creation_time", ("2024-01-31T12:00:00.000000Z", "2024-01-31T12:00:02.000000Z"), True),
        ("creation_time", ("2024-01-31T12:00:00.000000Z", "2024-01-31T12:00:01.000000Z"), False),
    ],
)
def test_videos_that_say_themselves_that_they_begin_apart_are_told(
    tmp_path: Path, key: str, begins: tuple[str, str], is_told: bool
) -> None:
    rig = ring_rig(2, image_size=SIZE)
    for camera, begin in zip(rig.names, begins, strict=True):
        with av.open(str(tmp_path / f"{camera}.mov"), "w") as file:
            target = file.add_stream("mpeg4", rate=10)
            target.width, target.height, target.pix_fmt = SIZE[1], SIZE[0], "yuv420p"
            (target if key == "timecode" else file).metadata[key] = begin
            file.mux(target.encode(av.VideoFrame.from_ndarray(picture(1), format="rgb24")))
            file.mux(target.encode(None))
    _, told = opened(str(tmp_path / "{camera}.mov"), rig)
    assert ["2 s apart" in sentence for sentence in told] == [True] * is_told


@pytest.mark.parametrize(
    ("missed", "interval", "is_told"), [(4, 60, True), (None, 60, False), (4, 0.5, True), (None, 0.5, False)]
)
def test_a_picture_that_one_camera_missed_is_told_by_exif(
    tmp_path: Path, missed: int | None, interval: float, is_told: bool
) -> None:
    for camera in RIG.names:
        (tmp_path / camera).mkdir()
        taken = [moment for moment in range(12) if camera != "cam2" or moment != missed]
        for number, moment in enumerate(taken):
            exif = Image.Exif()
            minutes, clock = divmod(moment * interval + 7 * (camera == "cam3"), 60)
            exif.get_ifd(0x8769)[0x9003] = f"2024:05:01 10:{minutes:02.0f}:{int(clock):02d}"
            if clock % 1:
                exif.get_ifd(0x8769)[0x9291] = "5"
            Image.fromarray(picture(1)).save(tmp_path / camera / f"{number}.jpg", exif=exif)
    _, told = opened(f"{tmp_path}/{{camera}}/{{frame}}.jpg")
    assert any("by EXIF those of cam2" in sentence for sentence in told) == is_told


def test_times_that_are_not_read_are_told(tmp_path: Path) -> None:
    images = as_videos(tmp_path / "a", EVERYTHING)
    for camera in RIG.names:
        np.save(tmp_path / "a" / f"{camera}_timestamps.npy", np.arange(10.0))
    (sentence,) = opened(images)[1]
    assert "cam1_timestamps.npy" in sentence


def test_two_tables_of_other_times_are_refused(tmp_path: Path) -> None:
    images = as_listed_files(tmp_path, EVERYTHING, "data.csv")
    (tmp_path / "cam1/times.csv").write_text(
        "".join(f"{number},{2e9 + number:.1f}\n" for number in range(10))
    )
    with pytest.raises(ArgumentError, match=r"data\.csv.*times\.csv"):
        open_source(images, RIG)


@pytest.mark.parametrize(
    ("name", "is_told"), [("image_rect", True), ("unrect", False), ("undistorted", True)]
)
def test_images_of_a_fisheye_that_are_called_rectified_are_asked_about(
    tmp_path: Path, name: str, is_told: bool
) -> None:
    (tmp_path / name).mkdir()
    images = as_counted_files(tmp_path / name, {camera: [1] for camera in RIG.names})
    assert any(name in sentence for sentence in opened(images)[1]) == is_told
    as_files_named(tmp_path / "plain", [f"{name}_1"])
    assert any(name in sentence for sentence in opened(str(tmp_path / "plain"))[1]) == is_told
    pinholes = {camera: PinholeCamera([50.0, 50.0], [24.0, 16.0], SIZE) for camera in RIG.names}
    assert not opened(images, CameraRig(pinholes, RIG.world_from_camera))[1]


@pytest.mark.parametrize(("where", "is_told"), [("ahead", False), ("around", True)])
def test_a_mask_that_hides_what_is_ahead_is_asked_about(tmp_path: Path, where: str, is_told: bool) -> None:
    """A mask for programs to which black is usable shows the surround of the image circle alone."""
    rig = ring_rig(2, image_size=(64, 64))
    v, u = np.mgrid[:64, :64] - 31.5
    is_ahead = np.hypot(u, v) < 28
    for name in rig.names:
        write_image(
            tmp_path / f"{name}.png", (is_ahead if where == "ahead" else ~is_ahead).astype(np.uint8) * 255
        )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        rig_with_masks(rig, str(tmp_path / "{camera}.png"))
    assert [str(w.message).startswith("masks: ") for w in caught] == [True] * is_told


def test_masks_lie_side_by_side_as_their_images(tmp_path: Path) -> None:
    masks = {
        name: torch.rand(SIZE, generator=torch.Generator().manual_seed(k)) > 0.5
        for k, name in enumerate("abc")
    }
    write_image(tmp_path / "mask.png", torch.cat(list(masks.values()), -1)[None].float())
    rig = CameraRig(dict(zip("abc", RIG.cameras.values(), strict=True)), RIG.world_from_camera)
    for cameras in (None, ["c", "a"]):
        masked, files = rig_with_masks(rig, str(tmp_path / "mask.png"), cameras)
        assert files == [tmp_path / "mask.png"]
        assert sorted(masked.masks) == sorted(cameras or rig.names)
        assert all((mask == masks[name]).all() for name, mask in masked.masks.items())
    with pytest.raises(FileFormatError, match=r"mask\.png: masks\['a'\]: expected shape \(64, 96\)"):
        rig_with_masks(rig.resized(dict.fromkeys(rig.names, (64, 96))), str(tmp_path / "mask.png"))


def test_a_video_cut_short_is_told(tmp_path: Path) -> None:
    """By frames that are missing where the header counts them, else by a warning; other lengths of headers are fine."""
    write_streams(tmp_path / "whole.avi", [("cam1", range(10))])
    write_streams(tmp_path / "whole.mkv", [("cam1", range(10))])
    one = RIG.subset(["cam1"])
    for name in ("whole.avi", "whole.mkv"):
        content = (tmp_path / name).read_bytes()
        cut = tmp_path / name.replace("whole", "cut")
        cut.write_bytes(content[: len(content) * 6 // 10])
        source, told = opened(str(tmp_path / name), one)
        frames = source.frames(Selection(), lambda _: True)
        assert [frame.images is not None for frame in frames] == [True] * 10
        assert told == []
        source, told = opened(str(cut), one)
        frames = list(source.frames(Selection(), lambda _: True))
        if name.endswith(".mkv"):
            assert "copy it again" in " ".join(told)
            assert 0 < len(frames) < 10
        else:
            assert len(frames) == 10
            assert frames[0].images is not None
            assert "of the 10 frames that its header promises" in str(frames[-1].error)
            content = bytearray(content)
            # Numbers of frames, which are read before these are
            for chunk, offset in ((b"avih", 24), (b"strh", 40)):
                start = content.index(chunk) + offset
                content[start : start + 4] = (2**31 - 1).to_bytes(4, "little")
            cut.write_bytes(content)
            source, told = opened(str(cut), one)
            assert len(source.names(Selection()) or []) == 10
            assert "that its header promises" in " ".join(told)
    for moments in (range(10), range(5, 10)):  # a header counts from its own beginning
        write_streams(tmp_path / "late.mkv", [("cam1", moments)])
        assert opened(str(tmp_path / "late.mkv"), one)[1] == []
