# SPDX-License-Identifier: Apache-2.0
"""Images of captures are found by pattern, however cameras and frames are numbered."""

from __future__ import annotations

import json
import os
import re
from itertools import permutations, product
from pathlib import Path
from typing import Any

import pytest
import torch

from sphericalvision.cameras import CameraRig, ring_rig, save_rig
from sphericalvision.capture.sources.frames import Selection
from sphericalvision.capture.sources.opening import open_source, rig_with_masks
from sphericalvision.capture.sources.patterns import find_files, find_labels
from sphericalvision.core import ArgumentError, MissingFileError
from sphericalvision.io.images import write_image
from sphericalvision.recipes.app.captures import Capture, PosedCapture, cameras_and_labels, evenly_chosen
from sphericalvision.recipes.app.rigs import make_ring
from tests.recipes.tiny import Run

NAMES = ["cam1", "cam2", "cam3"]


def find_capture(*arguments: Any, **keys: Any) -> dict[str, dict[str, Path]]:
    return find_files(*arguments, **keys).frames


def touch(root: Path, *names: str) -> str:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    return str(root)


PATTERNS: dict[str, tuple[list[str], str, list[Any] | None, list[str]]] = {
    "hidden files": (["{c}/1.png", "{c}/._1.png", "{c}/2.png"], "{camera}/{frame}.png", None, ["1", "2"]),
    "numbers": (["{c}/100.jpg", "{c}/9.jpg", "{c}/10.jpg"], "{camera}/{frame}.jpg", None, ["9", "10", "100"]),
    "times": (["{c}/0.76.jpg", "{c}/0.8.jpg"], "{camera}/{frame}.jpg", None, ["0.76", "0.8"]),
    "digits": (["{c}/7.jpg", "{c}/mask.jpg"], "{camera}/{frame:d}.jpg", None, ["7"]),
    "a word": (["{c}/7.jpg", "{c}/mask.jpg"], "{camera}/{frame}.jpg", ["mask"], ["mask"]),
    "twice": (["{c}/v{c}_01.png", "{c}/v{c}_02.png"], "{camera}/v{camera}_{frame:02d}.png", [2], ["02"]),
    "brackets": (["run [x] */cam{c}/1.png"], "run [x] */cam{camera}/{frame}.png", None, ["1"]),
    "from here": (["cam{c}/1.png"], "./cam{camera}/{frame}.png", None, ["1"]),
}
"""Files of each camera, a pattern, the frames asked for, and those that it finds, in order."""


@pytest.mark.parametrize(("files", "pattern", "asked", "expected"), PATTERNS.values(), ids=PATTERNS)
def test_frames_of_a_pattern(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    files: list[str],
    pattern: str,
    asked: list[Any] | None,
    expected: list[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    touch(tmp_path, *(file.format(c=camera) for camera in "123" for file in files))
    capture = find_capture(pattern, NAMES, asked)
    assert list(capture) == expected
    for cameras in capture.values():
        found = [path.resolve().relative_to(tmp_path.resolve()) for path in cameras.values()]
        assert [str(path.parent)[-1] for path in found] == ["1", "2", "3"]


LAYOUTS = {  # names of the cameras, and the folders of their images
    "names": (["front", "left", "rear"], ["front", "left", "rear"]),
    "numbers of names": (NAMES, ["1", "2", "3"]),
    "places from 0": (["front", "left", "rear"], ["0", "1", "2"]),
    "places from 1": (["front", "left", "rear"], ["1", "2", "3"]),
    "places from 0, other numbers in the names": (NAMES, ["0", "1", "2"]),
    "one number in two names": (["cam1_left", "cam1_right", "cam2"], ["0", "1", "2"]),
    "numbers and more folders": (NAMES, ["0", "1", "2", "3"]),
}


@pytest.mark.parametrize("source", ["{camera}/{frame}.png", "{camera}.png", "folder", "masks"])
@pytest.mark.parametrize(("names", "folders"), LAYOUTS.values(), ids=LAYOUTS)
def test_a_camera_has_the_same_files_whether_all_are_used_or_some(
    tmp_path: Path, names: list[str], folders: list[str], source: str
) -> None:
    """Which file is whose is decided on the whole rig: no selection, in any order, changes it."""
    rig = ring_rig(3, image_size=(16, 16))
    rig = CameraRig(dict(zip(names, rig.cameras.values(), strict=True)), rig.world_from_camera)
    for place, folder in enumerate(folders):
        file = tmp_path / (f"{folder}.png" if source == "{camera}.png" else f"{folder}/0001.png")
        write_image(file, torch.full((3, 16, 16), 1.0 if source == "masks" else place / 4))
    images = str(tmp_path if source == "folder" else tmp_path / source)

    def files(cameras: list[str] | None) -> dict[str, Path]:
        if source == "masks":
            masked, masks = rig_with_masks(rig, f"{tmp_path}/{{camera}}/0001.png", cameras)
            assert {*masked.masks} == {*(cameras or names)}
            return dict(zip(cameras or names, masks, strict=True))
        (files,) = open_source(images, rig, cameras=cameras).moments.values()
        return files

    whole = files(None)
    assert list(whole) == names
    assert len(set(whole.values())) == 3
    for number in (1, 2, 3):
        for some in permutations(names, number):
            assert files(list(some)) == {name: whole[name] for name in some}


def test_cameras_are_named_by_numbers_and_have_no_place(tmp_path: Path) -> None:
    rig = ring_rig(3, image_size=(16, 16))
    rig = CameraRig(dict(zip("123", rig.cameras.values(), strict=True)), rig.world_from_camera)
    save_rig(rig, tmp_path / "rig.yaml")
    for name in rig.names:
        write_image(tmp_path / f"{name}/0.png", torch.zeros(3, 16, 16))
        write_image(tmp_path / f"masks/{name}.png", torch.ones(3, 16, 16))
    keys: dict[str, Any] = {
        "calibration": f"{tmp_path}/rig.yaml",
        "images": f"{tmp_path}/{{camera}}/{{frame}}.png",
    }
    for masks in (None, f"{tmp_path}/masks/{{camera}}.png"):
        assert Capture(**keys, cameras=[2, 1], masks=masks).open().rig.names == ["2", "1"]
    with pytest.raises(ArgumentError, match="cameras: expected names among 1, 2, 3, got 0"):
        Capture(**keys, cameras=[0, 1]).open()


def test_what_is_wrong_with_the_layout_of_a_folder_is_told(tmp_path: Path) -> None:
    """And not that there is no layout."""
    rig = ring_rig(2, image_size=(16, 16))
    for name, time in {"cam1": "1700000000.00", "cam2": "1700000000.05"}.items():
        write_image(tmp_path / f"times/{name}/{time}.png", torch.zeros(3, 16, 16))
        write_image(tmp_path / f"numbers/{name}/1.png", torch.zeros(3, 16, 16))
    with pytest.raises(MissingFileError, match="tolerance"):
        open_source(str(tmp_path / "times"), rig)
    with pytest.raises(MissingFileError, match="frames="):
        open_source(str(tmp_path / "numbers"), rig, [9])
    with pytest.raises(ArgumentError, match="masks"):
        rig_with_masks(rig, f"{tmp_path}/mask.png")
    with pytest.raises(ArgumentError, match=r"cameras: .* of its own"):
        open_source(f"{tmp_path}/numbers/{{camera}}/{{frame}}.png", rig, labels={"cam1": "cam2"})


def test_a_name_with_a_colon_is_a_name() -> None:
    rig = ring_rig(3, image_size=(4, 4))
    named = CameraRig(dict(zip(("a:b", "c", "d"), rig.cameras.values(), strict=True)), rig.world_from_camera)
    assert cameras_and_labels(["c:x:y", "a:b"], named) == (["c", "a:b"], {"c": "x:y"})


@pytest.mark.parametrize(
    ("keys", "upwards", "forward", "down", "place"),
    [
        ({}, "-y", None, None, [1, 2, 3]),
        ({"up": "floor"}, "-y", None, None, [1, 2, 3]),
        ({"up": "y"}, "y", None, None, [1, -2, -3]),
        ({"poses": "p"}, "-y", None, None, [1, 2, 3]),
        ({"frame": "pose.txt"}, "z", [1, 0, 0], [0, 0, -1], [-7, -9, 5]),
        ({"frame": "pose.txt", "poses": "p"}, "z", [0, 1, 0], [0, 0, -1], [5, 7, 9]),
        ({"frame": "pose.txt", "poses": "p", "up": "y"}, "y", [0, 0, -1], [0, -1, 0], [5, 7, 9]),
        ({"frame": "pose.txt", "up": "y"}, None, None, None, None),
        ({"poses": "p", "up": "floor"}, None, None, None, None),
    ],
    ids=str,
)
def test_what_is_up_in_a_robots_frame(
    keys: dict[str, Any],
    upwards: str | None,
    forward: list[int] | None,
    down: list[int] | None,
    place: list[int] | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A robot has x forward, y left, z up; its world is turned by the least angle alone."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pose.txt").write_text("1 0 0 4\n0 1 0 5\n0 0 1 6\n")
    capture = PosedCapture(calibration="c", images="x", **keys)
    if upwards is None:
        with pytest.raises(ArgumentError, match="up: "):
            _ = capture.upwards
        return
    assert capture.upwards == upwards
    axes = capture.axes
    assert (axes is None) == (forward is None)
    if axes is not None:
        assert [(axes @ torch.eye(3)[k]).round().tolist() for k in (2, 1)] == [forward, down]
    moved = capture.placement(ring_rig(2)).float() @ torch.tensor([1.0, 2.0, 3.0, 1.0])
    assert moved[:3].tolist() == pytest.approx(place)


LABELS: dict[str, tuple[list[str], list[str], list[str], list[str] | None]] = {
    "names": (["front", "back", "0", "1"], ["front", "back"], ["front", "back"], ["front", "back"]),
    "numbers in names": (["1", "2", "3"], NAMES, NAMES, ["1", "2", "3"]),
    "padded numbers": (["00", "01"], ["cam0", "cam1"], ["cam0", "cam1"], ["00", "01"]),
    "numbers of some": (["1", "2"], NAMES, ["cam2"], ["2"]),
    "the order, from 0": (["0", "1", "2"], NAMES, ["cam2"], ["1"]),
    "the order, from 7": (["7", "8"], ["front", "back"], ["back"], ["8"]),
    "which of three": (["0", "1", "2"], ["front", "back"], ["front", "back"], None),
    "numbers against the order": (["0", "1"], ["cam2", "cam1"], ["cam2", "cam1"], None),
    "from 0, of some": (["0", "1"], NAMES, ["cam1"], None),
    "a number twice": (["1", "01", "2"], ["cam1", "cam2"], ["cam1", "cam2"], None),
    "other names": (["left", "right"], ["front", "back"], ["front", "back"], None),
}
"""Folders, cameras of the rig, those in use, and their folders; None where these cannot be told."""


@pytest.mark.parametrize(("folders", "names", "used", "expected"), LABELS.values(), ids=LABELS)
def test_labels_are_names_or_numbers_or_refused(
    tmp_path: Path, folders: list[str], names: list[str], used: list[str], expected: list[str] | None
) -> None:
    pattern = touch(tmp_path, *(f"{folder}/1.png" for folder in folders)) + "/{camera}/{frame}.png"
    if expected is not None:
        assert find_labels(pattern, names, used) == dict(zip(used, expected, strict=True))
        return
    with pytest.raises(MissingFileError, match=r"\{camera\} stands for"):
        find_labels(pattern, names, used)


def test_masks_by_number_say_whose_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = ring_rig(2, image_size=(16, 16))
    save_rig(
        CameraRig(dict(zip(("front", "back"), rig.cameras.values(), strict=True)), rig.world_from_camera),
        tmp_path / "rig.yaml",
    )
    for name in ("front", "back", "mask_0", "mask_1"):
        write_image(tmp_path / f"{name}.png", torch.ones(1, 16, 16))
    images, masks = f"{tmp_path}/{{camera}}.png", f"{tmp_path}/mask_{{camera}}.png"
    keys: Any = {"calibration": str(tmp_path / "rig.yaml"), "images": images, "masks": masks}
    for cameras, said in {
        None: "front is mask_0.png, back is",
        ("back", "front"): "back is mask_1.png, front is",
    }.items():
        Capture(**keys, cameras=cameras and [*cameras]).open()
        assert f"Masks: {said} mask_" in capsys.readouterr().out


@pytest.mark.parametrize("cameras", [None, ["cam1", "cam2"], ["cam3"]])
def test_stills_of_all_views_are_cut_as_videos_are(tmp_path: Path, cameras: list[str] | None) -> None:
    rig = ring_rig(3, image_size=(16, 16))
    views = torch.cat([torch.full((3, 16, 16), level) for level in (0.2, 0.4, 0.8)], -1)
    for frame in range(2):
        write_image(tmp_path / f"R{frame}.png", views)
    for images in (str(tmp_path), str(tmp_path / "{frame}.png")):
        source = open_source(images, rig, cameras=cameras)
        assert source.sizes() == dict.fromkeys(cameras or rig.names, (16, 16))
        frames = list(source.frames(Selection(), lambda _: True))
        assert [frame.name for frame in frames] == ["R0", "R1"]
        for name, image in frames[0].images.items():
            assert image.mean() == pytest.approx({"cam1": 0.2, "cam2": 0.4, "cam3": 0.8}[name], abs=0.01)
    with pytest.raises(ArgumentError, match="does not hold 4 views"):
        open_source(str(tmp_path / "{frame}.png"), ring_rig(4, image_size=(16, 16)))
    views = views.movedim(-1, -2)  # one above the other, which the first are not
    for frame, picture in {2: views[:, ::2, ::2], 3: views, 4: views[:, :20]}.items():
        write_image(tmp_path / f"R{frame}.png", picture)
    source = open_source(str(tmp_path), rig, cameras=cameras)
    _, _, *others = source.frames(Selection(), lambda _: True)
    for number, frame in enumerate(others, 2):
        assert f"R{number}.png: expected 48 x 16 pixels (width x height), as the first" in str(frame.error)


def test_some_frames_are_chosen_from_the_first_to_the_last(tmp_path: Path) -> None:
    for camera, frame in product(NAMES, range(7)):
        write_image(tmp_path / f"{camera}/{frame}.png", torch.zeros(3, 16, 16))
    source = open_source(str(tmp_path), ring_rig(3, image_size=(16, 16)))
    assert [frame.name for frame in evenly_chosen(source, 3)] == ["0", "3", "6"]


def test_requested_frames_are_given_in_their_order_or_what_is_missing_is_named(tmp_path: Path) -> None:
    root = touch(tmp_path, *(f"cam{c}/{f:03d}.png" for c in "123" for f in (1, 2)), "cam1/003.png")
    pattern = root + "/cam{camera}/{frame:03d}.png"
    assert list(find_capture(pattern, NAMES, [2, 1])) == ["002", "001"]
    assert list(find_capture(pattern.replace(":03d", ""), NAMES, ["002"])) == ["002"]
    for frame, missing in {3: "cam2/003.png", 7: "cam1/007.png"}.items():
        with pytest.raises(MissingFileError, match=re.escape(missing)):
            find_capture(pattern, NAMES, [frame])
    with pytest.raises(MissingFileError, match=r"\{frame:03d\} in the pattern stands for 002") as error:
        find_capture(root + "/cam1/{frame}.png", [""], [2])
    assert "camera" not in str(error.value)
    with pytest.raises(ArgumentError, match=r"pattern with \{camera\}"):
        find_capture(root + "/cam1/{frame}.png", NAMES)
    with pytest.raises(ArgumentError, match="frames"):
        find_capture(pattern, NAMES, ["first"])


@pytest.mark.parametrize(
    "names",
    [["cam[0]", "cam[1]", "cam*"], ["cam¹", "cam²", "cam³"], ["a b", "it's", "{x}"], ["-1", "..", "?"]],
    ids=["brackets", "superscripts", "quotes", "dots"],
)
def test_special_characters_in_names_are_literal(tmp_path: Path, names: list[str]) -> None:
    """Of cameras and of frames, which come after numbers."""
    frames = ["2", "10", "²", "[x]"]
    root = touch(tmp_path, *(f"{name}_/{frame}.png" for name in names for frame in frames))
    capture = find_capture(root + "/{camera}_/{frame}.png", names)
    assert sorted(capture, key=frames.index) == frames
    assert list(capture).index("2") < list(capture).index("10")
    assert all(files[name].parent.name == f"{name}_" for files in capture.values() for name in names)


@pytest.mark.parametrize("frame", [b"\xff1", b"a\nb", b"a\r", b"\xed\xa0\x80"], ids=ascii)
def test_names_that_no_table_holds_are_refused(tmp_path: Path, frame: bytes) -> None:
    """A line of a table is a frame, and tables are UTF-8."""
    root = touch(tmp_path, "1/1.png", "1/" + os.fsdecode(frame) + ".png")
    with pytest.raises(ArgumentError, match="expected a name in UTF-8 without line ends; rename it") as error:
        find_capture(root + "/{camera}/{frame}.png", ["1"])
    assert str(error.value).isascii()


def test_braces_in_the_name_of_a_calibration_are_literal(tmp_path: Path) -> None:
    """Fields alone make a pattern, whose folder is the calibration; a folder may be called like one."""
    rigs = {
        "{v2}": ring_rig(3, radius=0.2),
        "{camera}": ring_rig(3, radius=0.3),
        ".": ring_rig(3, radius=0.4),
    }
    for folder, rig in rigs.items():
        (tmp_path / folder).mkdir(exist_ok=True)
        save_rig(rig, tmp_path / folder / "rig.yaml")
        assert Capture(calibration=str(tmp_path / folder / "rig.yaml"), images="x").rig().radius == rig.radius
    with pytest.raises(MissingFileError, match=r"\{v3\}/rig.yaml"):
        Capture(calibration=f"{tmp_path}/{{v3}}/rig.yaml", images="x").rig()


def test_sizes_that_a_calibration_lacks_are_the_images_or_given(
    run: Run, failing: Run, tmp_path: Path
) -> None:
    frames = [
        {"file_path": f"cam{number}", "transform_matrix": pose.tolist()}
        for number, pose in enumerate(make_ring(2).world_from_camera)
    ]
    content = {"camera_angle_x": 1.5, "frames": frames}
    (tmp_path / "c").mkdir()
    (tmp_path / "c/transforms.json").write_text(json.dumps(content))
    keys: dict[str, Any] = {
        "calibration": f"{tmp_path}/c/transforms.json",
        "images": f"{tmp_path}/i[1]/{{camera}}.png",
    }
    for number in range(2):
        write_image(tmp_path / f"i[1]/cam{number}.png", torch.zeros(3, 24, 32))
    assert {camera.image_size for camera in Capture(**keys).open().rig.cameras.values()} == {(24, 32)}
    write_image(tmp_path / "i[1]/cam1.png", torch.zeros(3, 24, 40))
    with pytest.raises(ArgumentError, match=r"image_size: .* pass image_size=\[height,width\]"):
        Capture(**keys).open()
    for command in ("inspect", "convert"):
        message = failing(command, "calibration=c/transforms.json", f"output={command}.out")
        assert "pass image_size=[height,width]" in message
        run(command, "calibration=c/transforms.json", "image_size=[24,32]", f"output={command}.out")
    make_ring(2, image_size=(24, 32)).to_yaml(tmp_path / "c/rig.yaml")
    with pytest.raises(ArgumentError, match=r"image_size: .*rig\.yaml says itself"):
        Capture(**keys | {"calibration": f"{tmp_path}/c/rig.yaml", "image_size": [48, 64]}).open()
