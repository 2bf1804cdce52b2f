# SPDX-License-Identifier: Apache-2.0
"""COLMAP's cameras.txt: nine models, and half a pixel between its convention and this package's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from sphericalvision.cameras import (
    BrownConradyCamera,
    DoubleSphereCamera,
    KannalaBrandtCamera,
    PinholeCamera,
    read_camera,
    read_cameras,
    read_rig,
    save_camera,
)
from sphericalvision.cameras.calibration import write_colmap
from tests.cameras.calibration_samples import (
    COLMAP,
    assert_projects,
    directions,
    opencv_fisheye,
    opencv_plain,
)

LINES = [line.split() for line in COLMAP.splitlines() if not line.startswith("#")]


def write(path: Path, text: str = COLMAP) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize("words", LINES, ids=lambda words: words[1])
def test_each_model_projects_as_opencv_does_plus_half_a_pixel(tmp_path: Path, words: list[str]) -> None:
    """COLMAP counts from the corner of the first pixel, OpenCV from its centre."""
    camera = read_cameras(write(tmp_path / "cameras.txt"), dtype=torch.float64)[f"cam{words[0]}"]
    model, numbers = words[1], [float(word) for word in words[4:]]
    if len(numbers) in (3, 4, 5) and model != "PINHOLE":  # one focal length
        numbers = [numbers[0], *numbers]
    fx, fy, cx, cy, *distortion = numbers
    matrix = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    distortion += [0.0] * (4 - len(distortion))
    rays = directions(30.0)
    oracle = opencv_fisheye if "FISHEYE" in model else opencv_plain
    assert_projects(camera, oracle(rays, matrix, distortion) - 0.5, rays)
    kinds = {"FISHEYE": KannalaBrandtCamera, "PINHOLE": PinholeCamera}
    assert type(camera) is next((kind for key, kind in kinds.items() if key in model), BrownConradyCamera)


def test_convention_colmap_pixel_centers_are_half_a_pixel_further(tmp_path: Path) -> None:
    """The optical axis of a centred lens: (160, 120) there, (159.5, 119.5) here, for an image of 320 x 240."""
    camera = read_camera(write(tmp_path / "cameras.txt", "1 SIMPLE_PINHOLE 320 240 300 160 120\n"))
    assert camera.project(torch.tensor([0.0, 0.0, 1.0])).pixels.tolist() == [159.5, 119.5]


def test_cameras_are_read_back_as_written(tmp_path: Path) -> None:
    cameras = read_cameras(write(tmp_path / "source.txt"), dtype=torch.float64)
    write_colmap(cameras, tmp_path / "cameras.txt")
    again = read_cameras(tmp_path / "cameras.txt", dtype=torch.float64)
    assert list(again) == list(cameras)
    assert all(again[name].equals(camera) for name, camera in cameras.items())


def test_one_of_several_is_read_by_name(tmp_path: Path) -> None:
    path = write(tmp_path / "cameras.txt")
    assert type(read_camera(path, "cam9")) is KannalaBrandtCamera
    with pytest.raises(ValueError, match="holds 9 cameras; choose one of cam1, cam2"):
        read_camera(path)
    with pytest.raises(ValueError, match="has no camera 'cam10'"):
        read_camera(path, "cam10")
    with pytest.raises(ValueError, match="holds 9 cameras without poses"):
        read_rig(path)


def test_distortion_is_written_as_the_smallest_model_that_holds_it(tmp_path: Path) -> None:
    for distortion, model in (
        ([0.1, 0.02, 0.0, 0.0, 0.0], "OPENCV"),
        ([0.1, 0.02, 0.0, 0.0, 0.01], "FULL_OPENCV"),
        ([0.1, 0.02, 0.0, 0.0, 0.01, 0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], "FULL_OPENCV"),
    ):
        camera = BrownConradyCamera([300.0, 300.0], [159.5, 119.5], distortion, (240, 320))
        save_camera(camera, tmp_path / "cameras.txt", format="colmap")
        assert (tmp_path / "cameras.txt").read_text().splitlines()[1].split()[1] == model
    tilted = BrownConradyCamera([300.0, 300.0], [159.5, 119.5], [*[0.0] * 8, 0.01, 0, 0, 0], (240, 320), 0.4)
    with pytest.raises(ValueError, match="holds 8 numbers of distortion"):
        save_camera(tilted, tmp_path / "cameras.txt", format="colmap")


def test_other_models_are_refused_with_a_way_out(tmp_path: Path) -> None:
    sphere = DoubleSphereCamera([100.0, 100.0], [49.5, 49.5], -0.2, 0.6, (100, 100), 1.5)
    with pytest.raises(ValueError, match=r"'basalt' or 'kalibr'.*camera\.convert\(to=\.\.\.\)"):
        save_camera(sphere, tmp_path / "cameras.txt", format="colmap")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 FOV 320 240 300 300 160 120 0.9", "line 2: expected a model among SIMPLE_PINHOLE, .* got FOV"),
        ("1 PINHOLE 320 240 300 300 160", r"line 2, PINHOLE \(fx fy cx cy\): expected 4 numbers, got 3"),
        ("1 PINHOLE 320 240 300 wide 160 120", "line 2, PINHOLE .*expected numbers"),
        ("1 PINHOLE 320 nan 300 300 160 120", "line 2, width and height: expected finite numbers"),
        ("1 PINHOLE 320", "line 2: expected CAMERA_ID MODEL WIDTH HEIGHT"),
        (
            "one PINHOLE 320 240 300 300 160 120",
            "line 2: expected a camera number of its own first, got 'one'",
        ),
        ("1 PINHOLE 320 240 -300 300 160 120", "line 2: expected positive focal lengths"),
    ],
)
def test_broken_line_is_named(tmp_path: Path, line: str, message: str) -> None:
    with pytest.raises(ValueError, match=rf"cameras\.txt, {message}"):
        read_cameras(write(tmp_path / "cameras.txt", f"# comment\n{line}\n"))


def test_second_camera_of_a_number_is_refused(tmp_path: Path) -> None:
    line = "1 PINHOLE 320 240 300 300 160 120\n"
    with pytest.raises(ValueError, match="line 2: expected a camera number of its own first, got '1'"):
        read_cameras(write(tmp_path / "cameras.txt", line * 2))


def test_pixels_keep_every_digit(tmp_path: Path) -> None:
    focal = torch.tensor([1 / 3, np.pi], dtype=torch.float64) * 100
    camera = KannalaBrandtCamera(focal, [100 / 7, 200 / 7], [1e-17, 0.1, 1 / 3, 0.0], (64, 64), 0.2)
    save_camera(camera, tmp_path / "cameras.txt", format="colmap")
    again = read_camera(tmp_path / "cameras.txt", max_angle=0.2, dtype=torch.float64)
    assert torch.equal(again.focal_length, camera.focal_length)
    torch.testing.assert_close(again.principal_point, camera.principal_point, rtol=0, atol=1e-14)
