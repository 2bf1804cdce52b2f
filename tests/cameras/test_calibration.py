# SPDX-License-Identifier: Apache-2.0
"""Readers of calibrations: small files of every format, and what is said about broken ones."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import yaml

from sphericalvision.cameras import (
    CameraRig,
    OCamCamera,
    read_camera,
    read_rig,
    ring_rig,
    save_rig,
)
from sphericalvision.core import SphericalVisionError
from tests.cameras.calibration_samples import dump
from tests.laws.cameras import CAMERAS

OCAM = """#polynomial coefficients for the DIRECT mapping function

3 -1.000000e+02 0.0 2.500000e-03

#polynomial coefficients for the inverse mapping function

2 157.07963 100.0

#center: "row" and "column", starting from 0 (C convention)

119.5 160.25

#affine parameters "c", "d", "e"

1.0 0.0 0.0

#image size: "height" and "width"

240 320
"""
POSES_CM = """0 0 0 0 0 0
0 1.5707963 0 20 0 -20
0 3.1415927 0 0 0 -40
0 -1.5707963 0 -20 0 -20
"""


def write_folder(folder: Path, poses: str = POSES_CM, cameras: int = 4) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "poses.txt").write_text(poses)
    for number in range(1, cameras + 1):
        (folder / f"ocam{number}.txt").write_text(OCAM)
    return folder


def omnimvs(**changes: Any) -> dict[str, Any]:
    camera = {
        "cam_id": 1,
        "img_dir": "cam1",
        "model": "ocam",
        "poly": [3, -100.0, 0.0, 0.0025],
        "inv_poly": [2.0, 157.07963, 100.0],
        "center": [119.5, 160.25],
        "affine": [1.0, 0.0, 0.0],
        "image_size": [240, 320],
        "invalid_mask": "mask1.png",
        "pose": [0.0, 0.0, 0.0, 0.0, 0.0, 0.2],
        "max_fov": 190.0,
    }
    other = {
        **camera,
        "cam_id": 2,
        "pose": [0.0, math.pi / 2, 0.0, 0.2, 0.0, 0.0],
        "invalid_mask": "mask2.png",
    }
    return {"config": {"omnimvs_sweep_min_depth": 0.5}, "cameras": [{**camera, **changes}, other]}


def test_ocam_text(tmp_path: Path) -> None:
    path = tmp_path / "lens.txt"
    path.write_text(OCAM)
    camera = read_camera(path, dtype=torch.float64)
    assert isinstance(camera, OCamCamera)
    assert camera.polynomial.tolist() == [-100.0, 0.0, 0.0025]
    assert camera.inverse_polynomial is not None
    assert camera.inverse_polynomial.tolist() == [157.07963, 100.0]
    assert camera.principal_point.tolist() == [160.25, 119.5]
    assert camera.image_size == (240, 320)
    corner = camera.unproject(
        torch.tensor([0.0, 0.0], dtype=torch.float64)
    ).directions  # the farthest pixel centre
    assert camera.max_angle.item() == pytest.approx(math.acos(corner[2]))
    assert read_camera(path, max_angle=1.2).max_angle.item() == pytest.approx(1.2)


@pytest.mark.parametrize(("unit", "metres"), [("cm", 0.2), ("m", 20.0), ("mm", 0.02)])
def test_folder_of_ocam_files(tmp_path: Path, unit: str, metres: float) -> None:
    folder = write_folder(tmp_path / "set")
    if unit == "m":
        with pytest.warns(UserWarning, match=r"poses.txt.*20 m from their centre.*translation_unit"):
            rig = read_rig(folder, translation_unit=unit)
    else:
        rig = read_rig(folder, translation_unit=unit)
    assert rig.names == ["cam1", "cam2", "cam3", "cam4"]
    assert rig.radius.item() == pytest.approx(metres)
    axes = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0]])  # front, right, back, left
    torch.testing.assert_close(rig.axes, axes, rtol=0, atol=1e-6)
    torch.testing.assert_close(rig.center, torch.tensor([0.0, 0.0, -metres]))
    torch.testing.assert_close(rig.max_angles, torch.full((4,), math.radians(110)))
    assert torch.equal(read_rig(folder / "poses.txt", translation_unit="mm").axes, rig.axes)


def test_a_folder_may_state_its_unit(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "set", "# translation_unit: cm\n" + POSES_CM)
    assert read_rig(folder).radius.item() == pytest.approx(0.2)
    assert "says 'cm' itself, got 'mm'; leave it out" in refused(folder, translation_unit="mm")
    write_folder(folder, "# translation_unit: inch\n" + POSES_CM)
    assert "poses.txt: translation_unit: expected" in refused(folder)


def test_files_are_ordered_by_number(tmp_path: Path) -> None:
    poses = "".join(f"0 0 0 {index} 0 0\n" for index in range(1, 12))
    rig = read_rig(write_folder(tmp_path / "set", poses, cameras=11), translation_unit="cm")
    assert rig.names == [f"cam{number}" for number in range(1, 12)]


def test_omnimvs_config(tmp_path: Path) -> None:
    rig = read_rig(dump(tmp_path / "config.yaml", omnimvs()))
    assert rig.names == ["cam1", "cam2"]
    assert rig.cameras["cam1"].image_size == (240, 320)
    torch.testing.assert_close(rig.cameras["cam1"].principal_point, torch.tensor([160.25, 119.5]))
    torch.testing.assert_close(rig.max_angles, torch.full((2,), math.radians(95)))
    assert not rig.masks
    assert read_rig(tmp_path).names == rig.names  # its folder


def test_omnimvs_invalid_mask_is_white_where_a_pixel_must_not_be_used(tmp_path: Path) -> None:
    pixels = np.zeros((240, 320), np.uint8)
    pixels[:, :100] = 255
    cv2.imwrite(str(tmp_path / "mask2.png"), pixels)
    rig = read_rig(dump(tmp_path / "config.yaml", omnimvs()))
    assert list(rig.masks) == ["cam2"]
    assert torch.equal(rig.masks["cam2"], torch.from_numpy(pixels == 0))


def test_omnimvs_without_inverse_polynomial_inverts_exactly(tmp_path: Path) -> None:
    rig = read_rig(dump(tmp_path / "config.yaml", omnimvs(inv_poly=[])), dtype=torch.float64)
    camera = rig.cameras["cam1"]
    pixels = camera.pixel_grid()[::20, ::20]
    directions, valid = camera.unproject(pixels)
    torch.testing.assert_close(camera.project(directions).pixels[valid], pixels[valid])


def test_own_yaml_returns_the_same_rig(tmp_path: Path) -> None:
    cameras = {case.name: case.make(1.0).to(torch.float32) for case in CAMERAS}
    (name, lens), *_ = cameras.items()
    poses = torch.eye(4).repeat(len(cameras), 1, 1)
    poses[:, 0, 3] = torch.rand(len(cameras), generator=torch.Generator().manual_seed(0))
    mask = torch.rand(lens.image_size, generator=torch.Generator().manual_seed(1)) > 0.5
    rig = CameraRig(cameras, poses, {name: mask})
    rig.to_yaml(tmp_path / "rig.yaml")
    save_rig(rig, tmp_path / "any.thing")
    assert (tmp_path / "any.thing").read_text().startswith("format: sphericalvision-rig")
    again = read_rig(tmp_path / "rig.yaml")
    assert again.names == rig.names
    assert torch.equal(again.world_from_camera, poses)
    assert all(again.cameras[key].equals(camera) for key, camera in cameras.items())
    assert torch.equal(again.masks[name], mask)
    assert yaml.safe_load((tmp_path / "rig.yaml").read_text())["format"] == "sphericalvision-rig"


def test_own_yaml_keeps_double_precision(tmp_path: Path) -> None:
    rig = ring_rig(3, radius=0.1).to(torch.float64).rotated(tilt=0.123456789012)
    rig.to_yaml(tmp_path / "rig.yaml")
    assert torch.equal(
        read_rig(tmp_path / "rig.yaml", dtype=torch.float64).world_from_camera, rig.world_from_camera
    )


def test_batched_rig_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="select"):
        CameraRig.stack([ring_rig(), ring_rig()]).to_yaml(tmp_path / "rig.yaml")


# What is said about mistakes -----------------------------------------------------------------------------------------


def refused(path: Path, **options: Any) -> str:
    """The message with which a rig is refused."""
    with pytest.raises(SphericalVisionError) as caught:
        read_rig(path, **options)
    return str(caught.value)


def test_unit_of_poses_must_be_said(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "set")
    assert "translation_unit" in refused(folder)
    assert "'cm'" in refused(folder)
    assert "'m', 'cm', 'mm'" in refused(folder, translation_unit="inch")
    config = dump(tmp_path / "config.yaml", omnimvs())
    assert "in metres by its format" in refused(config, translation_unit="cm")


def test_broken_poses_name_file_and_line(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "set", POSES_CM.replace("20 0 -20", "nan 0 -20", 1))
    assert "poses.txt, line 2: expected finite numbers" in refused(folder, translation_unit="cm")
    write_folder(folder, POSES_CM.replace("0 0 -40", "0 -40"))
    assert "poses.txt, line 3: expected 6 numbers, got 5" in refused(folder, translation_unit="cm")


def test_wrong_number_of_cameras(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "set", cameras=3)
    message = refused(folder, translation_unit="cm")
    assert "holds 4 poses, but the folder has 3 cameras (ocam1.txt, ocam2.txt, ocam3.txt)" in message


def test_folder_with_two_calibrations_is_not_guessed(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "set")
    dump(folder / "config.yaml", omnimvs())
    message = refused(folder, translation_unit="cm")
    assert "poses.txt and config.yaml, which may differ in scale; name the one to read" in message


def test_mask_of_another_size_is_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "mask1.png"), np.zeros((24, 32), np.uint8))
    text = refused(dump(tmp_path / "config.yaml", omnimvs()))
    assert "mask1.png: expected 320 x 240 pixels (width x height" in text
    assert "got 32 x 24" in text


def test_what_is_no_calibration_says_what_is_known(tmp_path: Path) -> None:
    assert "no such file or folder" in refused(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    assert "none of rig.yaml, sensor.yaml, calibration.json" in refused(tmp_path / "empty")
    assert "not a calibration; known are" in refused(dump(tmp_path / "other.yaml", {"a": 1}))
    (tmp_path / "torn.json").write_text('{"value0": ')
    assert "not valid json" in refused(tmp_path / "torn.json")
    (tmp_path / "torn.yaml").write_text("a: [1, 2")
    assert "not valid YAML" in refused(tmp_path / "torn.yaml")
    (tmp_path / "lens.txt").write_text(OCAM)
    assert "use read_camera" in refused(tmp_path / "lens.txt")
    ring_rig().to_yaml(tmp_path / "rig.yaml")
    with pytest.raises(SphericalVisionError, match="use read_rig"):
        read_camera(tmp_path / "rig.yaml")
