# SPDX-License-Identifier: Apache-2.0
"""Images of captures are found by pattern, however cameras and frames are numbered."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from sphericalvision.capture.sources.frames import find_capture, find_masks
from sphericalvision.core import ArgumentError, MissingFileError
from sphericalvision.io.images import write_image
from sphericalvision.recipes.app.captures import Capture
from sphericalvision.recipes.app.rigs import make_ring
from tests.recipes.tiny import Run

NAMES = ["cam1", "cam2", "cam3"]


def touch(root: Path, *names: str) -> str:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    return str(root)


@pytest.mark.parametrize("labels", ["123", "012"])
def test_cameras_are_counted_from_one_or_from_zero(tmp_path: Path, labels: str) -> None:
    root = touch(tmp_path, *(f"cam{label}/{frame:05d}.png" for label in labels for frame in (2, 10)))
    files = find_capture(root + "/cam{camera}/{frame:05d}.png", NAMES)
    assert list(files) == ["00002", "00010"]
    assert [path.parent.name for path in files["00010"].values()] == [f"cam{label}" for label in labels]


def test_names_of_cameras_come_before_numbers(tmp_path: Path) -> None:
    root = touch(tmp_path, "front.png", "back.png", "0.png", "1.png")
    (files,) = find_capture(root + "/{camera}.png", ["front", "back"]).values()
    assert [path.name for path in files.values()] == ["front.png", "back.png"]


def test_frames_are_in_the_order_of_their_numbers_and_complete(tmp_path: Path) -> None:
    root = touch(tmp_path, *(f"{c}/{f}.jpg" for c in "123" for f in ("9", "10", "100")), "1/11.jpg")
    with pytest.warns(UserWarning, match=r"1 frame.* left out, 11 first \(cam1: 4, cam2: 3"):
        assert list(find_capture(root + "/{camera}/{frame}.jpg", NAMES)) == ["9", "10", "100"]


def test_digits_only_where_the_pattern_says_so(tmp_path: Path) -> None:
    root = touch(tmp_path, *(f"{c}/{f}.jpg" for c in "123" for f in ("7", "mask")))
    assert list(find_capture(root + "/{camera}/{frame:d}.jpg", NAMES)) == ["7"]
    assert list(find_capture(root + "/{camera}/{frame}.jpg", NAMES, ["mask"])) == ["mask"]


def test_a_camera_may_stand_twice_in_a_pattern(tmp_path: Path) -> None:
    root = touch(tmp_path, *(f"cam{c}/view{c}_{f:03d}.png" for c in "123" for f in (1, 2)))
    files = find_capture(root + "/cam{camera}/view{camera}_{frame:03d}.png", NAMES, [2])
    assert [path.name for path in files["002"].values()] == [
        "view1_002.png",
        "view2_002.png",
        "view3_002.png",
    ]


def test_special_characters_in_folders_are_literal(tmp_path: Path) -> None:
    root = touch(tmp_path / "run [1] *", "cam1/1.png", "cam2/1.png", "cam3/1.png")
    assert list(find_capture(root + "/cam{camera}/{frame}.png", NAMES)) == ["1"]


def test_relative_patterns_start_in_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    touch(tmp_path, "cam1/1.png", "cam2/1.png", "cam3/1.png")
    monkeypatch.chdir(tmp_path)
    assert list(find_capture("./cam{camera}/{frame}.png", NAMES)) == ["1"]


def test_masks_are_one_for_each_camera(tmp_path: Path) -> None:
    root = touch(tmp_path, *(f"cam{c}/mask.png" for c in "012"))
    assert list(find_masks(root + "/cam{camera}/mask.png", NAMES)) == NAMES
    with pytest.raises(ArgumentError, match="masks"):
        find_masks(root + "/mask.png", NAMES)


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    root = touch(tmp_path, "cam1/1.png", "cam2/1.png", "cam3/1.png", "cam1/2.png")
    with pytest.raises(MissingFileError, match=r"cam2/2\.png"):
        find_capture(root + "/cam{camera}/{frame}.png", NAMES, [2])
    with pytest.raises(MissingFileError, match=r"tried as cam1\.\.cam3, 1\.\.3, 0\.\.2"):
        find_capture(root + "/view{camera}/{frame}.png", NAMES)
    with pytest.raises(ArgumentError, match=r"pattern with \{camera\}"):
        find_capture(root + "/cam1/{frame}.png", NAMES)
    with pytest.raises(ArgumentError, match="frames"):
        find_capture(root + "/cam{camera}/{frame:05d}.png", NAMES, ["first"])


def test_sizes_that_a_calibration_lacks_are_the_images_or_given(
    run: Run, failing: Callable[..., str], tmp_path: Path
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
        "images": f"{tmp_path}/c/{{camera}}.png",
    }
    for number in range(2):
        write_image(tmp_path / f"c/cam{number}.png", torch.zeros(3, 24, 32))
    assert {camera.image_size for camera in Capture(**keys).open().rig.cameras.values()} == {(24, 32)}
    write_image(tmp_path / "c/cam1.png", torch.zeros(3, 24, 40))
    with pytest.raises(ArgumentError, match=r"image_size: .* pass image_size=\[height,width\]"):
        Capture(**keys).open()
    for command in ("inspect", "convert"):
        message = failing(command, "calibration=c/transforms.json", f"output={command}.out")
        assert "pass image_size=[height,width]" in message
        run(command, "calibration=c/transforms.json", "image_size=[24,32]", f"output={command}.out")
    make_ring(2, image_size=(24, 32)).to_yaml(tmp_path / "c/rig.yaml")
    with pytest.raises(ArgumentError, match=r"image_size: .*rig\.yaml says itself"):
        Capture(**keys | {"calibration": f"{tmp_path}/c/rig.yaml", "image_size": [48, 64]}).open()
