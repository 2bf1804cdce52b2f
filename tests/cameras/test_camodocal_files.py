# SPDX-License-Identifier: Apache-2.0
"""Camodocal's YAML: KITTI-360's fisheyes, alone and with their poses, and its pinhole and Kannala-Brandt cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sphericalvision.cameras import (
    read_camera,
    read_cameras,
    read_rig,
)
from sphericalvision.core import MissingFileError
from tests.cameras.calibration_samples import (
    SCARAMUZZA,
    camodocal_scaramuzza,
    dump,
    mei,
)

POSES = """image_00: 1 0 0 1.57 0 1 0 0.05 0 0 1 -1.55
image_02: 0.0 0.0 -1.0 0.7 1.0 0.0 0.0 -0.3 0.0 -1.0 0.0 -1.5
image_03: 0.0 0.0 1.0 0.7 -1.0 0.0 0.0 0.4 0.0 -1.0 0.0 -1.5
"""


def write_opencv_like(path: Path, content: dict[str, Any]) -> Path:
    """With the header of OpenCV's dialect, as KITTI-360 has it."""
    dump(path, content)
    path.write_text(f"%YAML:1.0\n---\n{path.read_text()}")
    return path


def test_several_cameras_in_one_file(tmp_path: Path) -> None:
    path = dump(tmp_path / "fisheyes.yaml", {"image_02": mei(), "image_03": mei()})
    assert list(read_cameras(path)) == ["image_02", "image_03"]
    assert read_camera(path, "image_03").equals(read_camera(path, "image_02"))


@pytest.mark.parametrize("affine", [{}, {"ac": 1.02, "ad": 0.003, "ae": -0.002}], ids=["plain", "affine"])
def test_scaramuzzas_lens_is_that_of_its_definition(tmp_path: Path, affine: dict[str, float]) -> None:
    """u = ac x + ad y + cx and v = ae x + y + cy look along (x, y, -p(r)), as camodocal's source has it."""
    camera = read_camera(dump(tmp_path / "pal.yaml", camodocal_scaramuzza(**affine)), dtype=torch.float64)
    ac, ad, ae = (affine.get(key, default) for key, default in (("ac", 1.0), ("ad", 0.0), ("ae", 0.0)))
    ideal = np.array([[200.0, -100.0], [-150.0, 30.0], [5.0, 250.0], [420.0, 90.0]])
    pixels = ideal @ np.array([[ac, ad], [ae, 1.0]]).T + (645.1, 486.0)
    z = -np.polynomial.polynomial.polyval(np.hypot(*ideal.T), SCARAMUZZA)
    expected = np.column_stack((ideal, z)) / np.hypot(np.hypot(*ideal.T), z)[:, None]
    directions, valid = camera.unproject(torch.from_numpy(pixels))
    assert valid.all()
    assert np.allclose(directions.numpy(), expected, atol=1e-9)
    assert np.allclose(
        camera.project(directions).pixels.numpy(), pixels, atol=1.0
    )  # by the file's own inverse


def test_folder_with_poses_is_a_rig(tmp_path: Path) -> None:
    """The vehicle's frame has x forward, y right, z down; camera 2 looks left, camera 3 right."""
    for name in ("image_02", "image_03"):
        write_opencv_like(tmp_path / f"{name}.yaml", mei(camera_name=name))
    (tmp_path / "calib_cam_to_pose.txt").write_text(POSES)
    for path in (tmp_path, tmp_path / "calib_cam_to_pose.txt"):
        rig = read_rig(path)
        assert rig.names == ["image_02", "image_03"]
        torch.testing.assert_close(rig.axes, torch.tensor([[-1.0, 0, 0], [1, 0, 0]]))
        torch.testing.assert_close(rig.positions[:, 1], torch.tensor([-0.3, 0.4]))


def test_poses_without_cameras_say_what_is_missing(tmp_path: Path) -> None:
    (tmp_path / "calib_cam_to_pose.txt").write_text(POSES)
    with pytest.raises(MissingFileError, match=r"image_02\.yaml"):
        read_rig(tmp_path)
    write_opencv_like(tmp_path / "image_02.yaml", mei())
    (tmp_path / "calib_cam_to_pose.txt").write_text(POSES.replace("-0.3 0.0 -1.0 0.0 -1.5", "-0.3 0.0"))
    with pytest.raises(ValueError, match="line 2, image_02: expected 4 rows of 4 numbers, got 9"):
        read_rig(tmp_path)


def test_camera_without_pose_makes_no_rig(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"holds one camera without poses, .* use read_camera"):
        read_rig(dump(tmp_path / "image_02.yaml", mei()))


def test_field_of_view_ends_where_the_model_does(tmp_path: Path) -> None:
    """In an image larger than the image circle, bisection between the centre and the border finds the circle's edge."""
    values = mei(image_width=9000, image_height=9000)
    values["projection_parameters"] |= {"u0": 4499.5, "v0": 4499.5}
    values["distortion_parameters"] = dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)
    camera = read_camera(dump(tmp_path / "image_02.yaml", values), dtype=torch.float64)
    limit = np.arccos(-1 / 2.2134)  # where a larger angle no longer means a larger radius
    assert camera.max_angle.item() == pytest.approx(limit, abs=1e-5)
