# SPDX-License-Identifier: Apache-2.0
"""Converting and inspecting calibrations from the command line."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
import torch

from sphericalvision.cameras import (
    CameraRig,
    DoubleSphereCamera,
    KannalaBrandtCamera,
    read_camera,
    read_rig,
    ring_rig,
    save_camera,
)
from sphericalvision.io.images import read_image, write_image
from tests.recipes.tiny import Run, typed

LENS = DoubleSphereCamera([75.0, 75.0], [152.3, 151.5], -0.2, 0.6, (304, 304), math.radians(100))
POINTS = torch.tensor([[0.3, -0.2, 1.0], [1.0, 0.0, -0.1], [0.0, 1.0, 0.2]])


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    """A rig of four equal lenses."""
    poses = ring_rig(4).world_from_camera
    CameraRig(dict.fromkeys(("front", "right", "back", "left"), LENS), poses).to_yaml(tmp_path / "rig.yaml")
    return tmp_path / "rig.yaml"


def test_a_rig_is_converted_with_its_poses(run: Run, calibration: Path) -> None:
    run("convert", f"calibration={calibration}", "to=kannala_brandt", "output=new/kb.yaml")
    old, new = read_rig(calibration), read_rig(calibration.parent / "new/kb.yaml")
    assert new.names == old.names
    torch.testing.assert_close(new.world_from_camera, old.world_from_camera)
    for camera in new.cameras.values():
        assert isinstance(camera, KannalaBrandtCamera)
        torch.testing.assert_close(
            camera.project(POINTS).pixels, LENS.project(POINTS).pixels, rtol=0, atol=0.01
        )
    assert sorted(path.name for path in (calibration.parent / "new").iterdir()) == ["kb.yaml"]


def test_without_output_nothing_is_written(run: Run, calibration: Path) -> None:
    printed = run("convert", f"calibration={calibration}", "to=pinhole", "camera=front", "fit_angle_deg=40")
    assert "80.0°" in printed, "what is kept of the field of view"
    assert sorted(path.name for path in calibration.parent.iterdir()) == ["rig.yaml"]


def test_a_rig_is_inspected(run: Run, calibration: Path) -> None:
    printed = run("inspect", f"calibration={calibration}", "level=4", "output=seen")
    for expected in ("double_sphere", "200.0°", "0.400", "0.283", "by two or more", "far away"):
        assert expected in printed
    folder = calibration.parent / "seen"
    names = [f"angles_{name}" for name in ("front", "right", "back", "left")]
    names += ["rig", "coverage_1m", "coverage_far"]
    assert sorted(path.name for path in folder.iterdir()) == sorted(f"{name}.png" for name in names)
    assert all(read_image(path).std() > 0.05 for path in folder.iterdir())


def test_images_and_masks_are_drawn(run: Run, calibration: Path) -> None:
    for name in ("front", "right", "back", "left"):
        for number in range(2):
            write_image(calibration.parent / f"{name}/{number}.png", torch.rand(3, 304, 304))
        write_image(calibration.parent / name / "mask.png", torch.ones(1, 304, 304))
    pictures = []
    for frame in ("", "frame=0", "frame=1"):
        images = f"images={{camera}}/{{frame}}.png masks={{camera}}/mask.png {frame}"
        run(*typed(f"inspect calibration={calibration} {images} level=3 output=seen{len(pictures)}"))
        pictures.append((calibration.parent / f"seen{len(pictures)}/angles_left.png").read_bytes())
    assert pictures[0] == pictures[1] != pictures[2]


def test_one_camera_without_poses_is_inspected(run: Run, tmp_path: Path) -> None:
    save_camera(LENS, tmp_path / "lens.yaml")
    assert "no poses" in run("inspect", "calibration=lens.yaml", "output=seen")
    assert len(list((tmp_path / "seen").iterdir())) == 1


def test_names_of_cameras_lead_nowhere(run: Run, tmp_path: Path) -> None:
    names = ["../../../../outside", "/tmp/outside"]
    rig = CameraRig(dict.fromkeys(names, LENS), ring_rig(2).world_from_camera)
    rig.to_yaml(tmp_path / "rig.yaml")
    before = set(tmp_path.rglob("*"))
    run("inspect", "calibration=rig.yaml", "level=3", "depths=[1]", "output=a/b/c/seen")
    pictures = {path for path in tmp_path.rglob("*") if path.is_file()} - before
    assert len([path for path in pictures if "outside" in path.name]) == 2
    assert {path.parent for path in pictures} == {tmp_path / "a/b/c/seen"}


def test_two_calibrations_are_compared_by_the_angle_from_the_axis(
    run: Run, failing: Run, calibration: Path
) -> None:
    wider = DoubleSphereCamera([76.5, 75.0], [152.3, 151.5], -0.2, 0.6, (304, 304), math.radians(100))
    poses = ring_rig(4, radius=0.21).world_from_camera
    CameraRig([wider] * 4, poses).to_yaml(calibration.parent / "other.yaml")
    printed = run("convert", f"calibration={calibration}", "with=other.yaml", "camera=right")
    rows = [
        [float(x) for x in re.findall(r"[\d.]+", row)]
        for row in printed.splitlines()
        if re.match(r"│ +\d", row)
    ]
    assert [row[0] for row in rows] == [*range(0, 100, 10), 100.0]
    points = torch.tensor([[math.sin(1.0471976), 0.0, math.cos(1.0471976)]], dtype=torch.float64)
    at_60 = float((wider.project(points).pixels - LENS.project(points).pixels)[0, 0])
    assert abs(rows[6][2] - at_60) < 1e-3  # the largest, to the right, where f differs by 2 %
    assert 0.5 * at_60 < rows[6][1] < at_60
    assert all(0 <= row[3] <= row[4] < 3 for row in rows)
    assert "right" in printed
    assert "By their order: front with cam1, right with cam2, " in printed
    assert "left: " not in printed.split("Poses")[0]
    assert "14.14" in printed.split("Poses")[1]  # 10 mm outwards, as seen from another that moved as much
    names = read_rig(calibration).names
    CameraRig(dict.fromkeys(names, wider), poses).subset(names[::-1]).to_yaml(
        calibration.parent / "back.yaml"
    )
    back = run("convert", f"calibration={calibration}", "with=back.yaml", "camera=right")
    assert back.split("Poses")[1] == printed.split("Poses")[1]
    small = LENS.resized((152, 152))
    CameraRig([small] * 4, poses).to_yaml(calibration.parent / "small.yaml")
    for words, message in (
        (("with=small.yaml",), "with, front: expected 304 x 304 pixels"),
        (("with=other.yaml", "to=ocam"), "to: counts only without with="),
        (("with=none.yaml",), "none.yaml: no such file"),
        (("with=other.yaml", "camera=top"), "camera: expected one of front"),
    ):
        assert message in failing("convert", f"calibration={calibration}", *words)
    save_camera(LENS, calibration.parent / "one.yaml")
    assert "with: expected a camera front in one.yaml" in failing(
        "convert", f"calibration={calibration}", "with=one.yaml"
    )
    assert "Poses" not in run("convert", "calibration=one.yaml", "with=one.yaml")


@pytest.mark.parametrize(
    ("words", "file", "model"),
    [
        ("calibration=rig.yaml camera=left to=ocam format=ocamcalib", "new.txt", "ocam"),
        ("calibration=lens.yaml to=extended_unified format=basalt", "new.json", "extended_unified"),
        ("calibration=rig.yaml camera=front to=kb4", "new.yaml", "kannala_brandt"),
        ("calibration=rig.yaml camera=front to=OPENCV_FISHEYE", "new.yaml", "kannala_brandt"),
    ],
)
def test_one_camera_is_converted_to_models_by_all_their_names(
    run: Run, calibration: Path, words: str, file: str, model: str
) -> None:
    save_camera(LENS, calibration.parent / "lens.yaml")
    run("convert", *typed(words), f"output={file}")
    camera = read_camera(calibration.parent / file, max_angle=LENS.max_angle)
    assert camera.model == model
    torch.testing.assert_close(camera.project(POINTS).pixels, LENS.project(POINTS).pixels, rtol=0, atol=0.02)
