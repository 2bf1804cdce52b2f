# SPDX-License-Identifier: Apache-2.0
"""OpenCV's FileStorage: plain, fisheye and omnidir cameras, pairs of them, in YAML, XML and JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from sphericalvision.cameras import BrownConradyCamera, convert, read_camera, save_camera
from sphericalvision.core import ArgumentError
from tests.cameras.calibration_samples import (
    MATRIX,
    assert_projects,
    directions,
    dump,
    opencv_fisheye,
    opencv_omnidir,
    opencv_plain,
    storage,
)

PLAIN = [-0.28, 0.07, 0.001, -0.002, 0.01]


def write(path: Path, **values: Any) -> Path:
    return dump(path, storage(**values))


@pytest.mark.parametrize("kind", ["fisheye", "omnidir"])
def test_skew_is_opencvs_and_goes_through_all_that_cameras_do(tmp_path: Path, kind: str) -> None:
    """A matrix as its calibrations return it; no other format takes such a camera without a word."""
    distortion, skew, rays = [-0.01, 0.02, 1e-3, -2e-3], 2.5, directions(70.0)
    values: dict[str, Any] = {"xi": 1.2} if kind == "omnidir" else {"fisheye_model": 1}
    matrix = [[400.0, skew, 320.5], [0.0, 401.0, 240.25], [0.0, 0.0, 1.0]]
    path = write(
        tmp_path / "c.yml", image_width=640, image_height=480, camera_matrix=matrix, D=distortion, **values
    )
    camera = read_camera(path, dtype=torch.float64)
    if kind == "omnidir":
        expected = opencv_omnidir(rays, matrix, 1.2, distortion)
    else:
        expected = opencv_fisheye(rays, matrix, distortion, alpha=skew / 400)
    assert_projects(camera, expected, rays)
    save_camera(camera, tmp_path / "again.yml", "opencv")
    assert_projects(read_camera(tmp_path / "again.yml", dtype=torch.float64), expected, rays)
    half = camera.resized((240, 320))
    assert_projects(half, (expected + 0.5) / 2 - 0.5, rays)
    assert convert(camera, to=type(camera)).max_error == 0
    held, lost = (convert(camera, to=model, max_angle=0.6).max_error for model in ("ocam", "double_sphere"))
    assert held < 0.2 < lost
    with pytest.raises(
        ArgumentError, match=r"the format 'kalibr' has no skew; write it as 'native' or 'opencv'"
    ):
        save_camera(camera, tmp_path / "kalibr.yaml", "kalibr")


def test_image_size_can_be_given_where_the_file_does_not_tell(tmp_path: Path) -> None:
    path = write(tmp_path / "intrinsics.yml", K=MATRIX, D=PLAIN)
    with pytest.raises(
        ValueError, match=r"intrinsics\.yml does not tell image_width .* image_size=\(height, width\)"
    ):
        read_camera(path)
    assert read_camera(path, image_size=(240, 320)).image_size == (240, 320)
    for start in ("", "# a comment\n\n---\n"):
        text = f"{start}image_size: [320, 240]\ncamera_matrix: [[300, 0, 159], [0, 300, 119], [0, 0, 1]]\n"
        (tmp_path / "no_suffix").write_text(text)
        assert read_camera(tmp_path / "no_suffix").image_size == (240, 320)
    with pytest.raises(ArgumentError, match=r"max_angle: expected radians .* 110"):
        read_camera(tmp_path / "no_suffix", max_angle=110)


@pytest.mark.parametrize("suffix", [".yaml", ".yml", ".xml", ".json"])
def test_files_that_opencv_writes_are_read(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"camera{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Sat 21 Nov 2026 07:00:00")
    storage.write("image_width", 320)
    storage.write("image_height", 240)
    storage.write("camera_matrix", np.array(MATRIX))
    storage.write("distortion_coefficients", np.array([PLAIN]))
    storage.write("per_view_reprojection_errors", np.array([[0.1], [0.2]], np.float32))
    storage.release()
    camera = read_camera(path, dtype=torch.float64)
    assert isinstance(camera, BrownConradyCamera)
    assert camera.focal_length.tolist() == [300.5, 301.0]
    assert camera.principal_point.tolist() == [159.25, 120.75]
    assert camera.distortion.tolist() == PLAIN


@pytest.mark.parametrize("suffix", [".yaml", ".xml", ".json"])
def test_opencv_reads_what_is_written_and_it_is_read_back(tmp_path: Path, suffix: str) -> None:
    focal = torch.tensor([300.1, 299.9], dtype=torch.float64)
    camera = BrownConradyCamera(focal, [159.3, 120.7], [-1 / 3, 0.1, 0, 0, 0.0], (240, 320))
    path = tmp_path / f"camera{suffix}"
    save_camera(camera, path, format="opencv")
    again = read_camera(path, max_angle=float(camera.max_angle), dtype=torch.float64)
    assert again.equals(camera)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    matrix, distortion = (storage.getNode(key).mat() for key in ("camera_matrix", "distortion_coefficients"))
    rays = directions(20.0)
    assert_projects(camera, opencv_plain(rays, matrix, distortion), rays)
