# SPDX-License-Identifier: Apache-2.0
"""What formats have of their own: defaults, older spellings, and what other programs read of what is written."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from sphericalvision.cameras import (
    CameraRig,
    EquirectangularCamera,
    KannalaBrandtCamera,
    OCamCamera,
    PinholeCamera,
    read_camera,
    read_cameras,
    read_rig,
    save_camera,
    save_rig,
)
from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.geometry import transform_from_axis_angle
from tests.cameras.calibration_samples import RIGHT_OF_FIRST, TEXTS, dump, sample
from tests.cameras.test_format_lenses import rational

# nerfstudio -----------------------------------------------------------------------------------------------------------


def test_angle_of_view_stands_for_a_focal_length(tmp_path: Path) -> None:
    """The synthetic NeRF scenes have nothing else, and not even a size."""
    content = {"camera_angle_x": math.pi / 2, "frames": sample("transforms.json")["frames"]}
    path = dump(tmp_path / "transforms_train.json", content)
    camera = read_camera(path, image_size=(80, 100))
    assert isinstance(camera, PinholeCamera)
    torch.testing.assert_close(camera.focal_length, torch.tensor([50.0, 50.0]))
    assert camera.principal_point.tolist() == [49.5, 39.5]
    with pytest.raises(ValueError, match=r"w and h; pass image_size"):
        read_camera(path)


def test_frames_may_have_lenses_of_their_own(tmp_path: Path) -> None:
    content = sample("transforms.json", camera_model="OPENCV", k3=0.0, k4=0.0, p1=1e-3, p2=0.0)
    content["frames"][0] |= {key: content.pop(key) for key in ("fl_x", "w")}
    content["frames"][1] |= {"fl_x": 300.0, "w": 640}
    cameras = read_cameras(dump(tmp_path / "transforms.json", content))
    first, second = cameras.values()
    assert first.model == second.model == "brown_conrady"
    assert (first.focal_length[0].item(), second.focal_length[0].item()) == pytest.approx((190.98, 300.0))
    assert (first.image_size, second.image_size) == ((512, 512), (512, 640))


def test_instant_ngps_flag_makes_a_fisheye(tmp_path: Path) -> None:
    content = sample("transforms.json", is_fisheye=True)
    del content["camera_model"]
    camera = read_camera(dump(tmp_path / "transforms.json", content))
    assert camera.equals(read_camera(dump(tmp_path / "other.json", sample("transforms.json"))))


def test_panoramas_see_everything(tmp_path: Path) -> None:
    path = dump(tmp_path / "transforms.json", sample("transforms.json", camera_model="EQUIRECTANGULAR"))
    assert read_camera(path).equals(EquirectangularCamera((512, 512)))
    rig = CameraRig([EquirectangularCamera((64, 128))], torch.eye(4)[None])
    save_rig(rig, path, "nerfstudio")
    assert read_rig(path).cameras["images/cam1"].equals(rig.cameras["cam1"])


def test_poses_come_back_in_opengls_axes(tmp_path: Path) -> None:
    """The writer's matrices are those that nerfstudio expects, not only those that the reader undoes."""
    rig = read_rig(dump(tmp_path / "transforms.json", sample("transforms.json")), dtype=torch.float64)
    save_rig(rig, tmp_path / "again.json", "nerfstudio")
    frames = json.loads((tmp_path / "again.json").read_text())["frames"]
    for frame, source in zip(frames, sample("transforms.json")["frames"], strict=True):
        np.testing.assert_allclose(frame["transform_matrix"], source["transform_matrix"], atol=1e-12)


# OCam ---------------------------------------------------------------------------------------------------------------


def test_convention_ocam_center_is_row_column_in_files(tmp_path: Path) -> None:
    """Row 119.5, column 160.25; height 240, width 320. The view ends at the corner."""
    path = dump(tmp_path / "lens.txt", TEXTS["lens.txt"])
    camera = read_camera(path, dtype=torch.float64)
    assert isinstance(camera, OCamCamera)
    assert camera.polynomial.tolist() == [-100.0, 0.0, 0.0025]
    assert camera.inverse_polynomial is not None
    assert camera.inverse_polynomial.tolist() == [157.07963, 100.0]
    assert camera.principal_point.tolist() == [160.25, 119.5]
    assert camera.image_size == (240, 320)
    corner = camera.unproject(torch.zeros(2).double()).directions  # the farthest pixel centre
    assert camera.max_angle.item() == pytest.approx(math.acos(corner[2]))
    assert read_camera(path, max_angle=1.2).max_angle.item() == pytest.approx(1.2)
    right, down = camera.exact().project(torch.tensor([0.1, 0.01, 1.0])).pixels - camera.principal_point
    assert right > down > 0


def test_omnimvs_without_inverse_polynomial_inverts_exactly(tmp_path: Path) -> None:
    content = sample("config.yaml")
    content["cameras"][0]["inv_poly"] = []
    camera = read_rig(dump(tmp_path / "config.yaml", content), dtype=torch.float64).cameras["cam1"]
    pixels = camera.pixel_grid()[::20, ::20]
    directions, valid = camera.unproject(pixels)
    torch.testing.assert_close(camera.project(directions).pixels[valid], pixels[valid])


def lens(third: float = 1 / 3) -> OCamCamera:
    return OCamCamera(
        torch.tensor([-100.0 - third, 0.0, 2.5e-3, 1e-9], dtype=torch.float64),
        [157.1, 99.9, third],
        [160.1, 119.3],
        [1.001, 1e-3, -2e-3],
        (240, 320),
        math.radians(100),
    )


@pytest.mark.parametrize(("numbers", "other"), [("157.1", "197.1"), ("157.1", "-157.1"), ("0.0025 ", "2.5 ")])
def test_polynomials_of_two_lenses_are_refused(tmp_path: Path, numbers: str, other: str) -> None:
    path = tmp_path / "lens.txt"
    save_camera(lens(), path, format="ocamcalib")
    path.write_text(path.read_text().replace(numbers, other))
    with pytest.raises(
        FileFormatError, match=r"lens\.txt.*: the direct and the inverse polynomial contradict"
    ):
        read_camera(path)


@pytest.mark.parametrize("names", [["cam1", "cam3"], ["front", "right"]])
def test_names_with_a_number_and_fields_of_view_are_kept(tmp_path: Path, names: list[str]) -> None:
    poses = transform_from_axis_angle(
        torch.zeros(2, 3).double(), torch.tensor([[0.1, 0, 0], [0, 0, -0.1]]).double()
    )
    rig = CameraRig(dict(zip(names, (lens(), lens(0.3)), strict=True)), poses)
    save_rig(rig, tmp_path / "config.yaml", format="omnimvs")
    again = read_rig(tmp_path, dtype=torch.float64)
    assert again.names == (names if names[0] == "cam1" else ["cam1", "cam2"])
    torch.testing.assert_close(again.max_angles, rig.max_angles, rtol=0, atol=1e-15)
    assert read_rig(tmp_path, max_angle=0.75).max_angles.tolist() == [0.75, 0.75]


def test_keys_without_a_space_before_their_value_are_read(tmp_path: Path) -> None:
    """As in files that MultiCol-SLAM publishes: ``Camera.a0:-209.07``, which is no pair to YAML."""
    text = f"%YAML:1.0\n\n{''.join(f'{key}: {value}' + chr(10) for key, value in sample('fisheye.yaml').items())}"
    path, tight = (dump(tmp_path / f"{k}.yaml", t) for k, t in enumerate((text, text.replace(": ", ":"))))
    assert "Camera.a0:-" in tight.read_text()
    assert read_camera(tight).equals(read_camera(path))


# Fields of view, sizes, principal points ------------------------------------------------------------------------------


def test_field_of_view_ends_where_the_model_does(tmp_path: Path) -> None:
    """In an image larger than the image circle, bisection between the centre and the border finds the circle's edge."""
    values = sample("image_02.yaml", image_width=9000, image_height=9000)
    values["projection_parameters"] |= {"u0": 4499.5, "v0": 4499.5}
    values["distortion_parameters"] = dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)
    camera = read_camera(dump(tmp_path / "image_02.yaml", values), dtype=torch.float64)
    limit = np.arccos(-1 / 2.2134)  # where a larger angle no longer means a larger radius
    assert camera.max_angle.item() == pytest.approx(limit, abs=1e-5)


@pytest.mark.parametrize("radius", [0.0, 0.8])
def test_rational_distortion_ends_at_its_radius_and_is_written(tmp_path: Path, radius: float) -> None:
    camera = read_camera(dump(tmp_path / "calibration.json", rational(radius)), dtype=torch.float64)
    assert not radius or camera.max_angle <= np.arctan(radius)
    save_camera(camera, tmp_path / "again.json", format="basalt")
    again = read_camera(tmp_path / "again.json", dtype=torch.float64)
    assert again.with_max_angle(camera.max_angle).equals(camera)


def test_convention_woodscape_principal_point_is_offset_from_the_middle(tmp_path: Path) -> None:
    """Without offsets it is the middle of the image, (w - 1) / 2 where the first pixel's centre is 0."""
    content = sample("FV.json")
    content["intrinsic"] |= {"cx_offset": 0.0, "cy_offset": 0.0}
    assert read_camera(dump(tmp_path / "FV.json", content)).principal_point.tolist() == [639.5, 482.5]


def test_svos_first_age_has_shares_of_the_sides(tmp_path: Path) -> None:
    atan = read_camera(dump(tmp_path / "atan.yaml", TEXTS["atan.yaml"]), dtype=torch.float64)
    assert atan.focal_length.tolist() == [0.51 * 752, 0.8 * 480]
    assert atan.principal_point.tolist() == [375.5, 0.52 * 480 - 0.5]


def test_sizes_are_those_of_sensors_or_given(tmp_path: Path) -> None:
    """Of Aria by label and principal point; py-OCamCalib tells none; a size that the file has must be met."""
    content = sample("device.json")
    path = dump(tmp_path / "device.json", content)
    assert read_cameras(path)["camera-slam-left"].image_size == (480, 640)
    assert read_cameras(path, image_size=(240, 320))["camera-rgb"].image_size == (240, 320)
    for label in ("left", "camera-rgb-2"):  # whose sensor has its middle elsewhere
        content["CameraCalibrations"][0]["Label"] = label
        with pytest.raises(ArgumentError, match=rf"image_size: .*'{label}'"):
            read_cameras(dump(path, content))
    path = dump(tmp_path / "c.json", TEXTS["calibration_fisheye.json"])
    assert list(read_cameras(path, image_size=(240, 320))) == ["fisheye_1"]
    with pytest.raises(ArgumentError, match=r"image_size: .*does not tell it"):
        read_camera(path)
    for name in ("sensor.yaml", "plain.yml", "FV.json", "transforms.json"):
        path = dump(tmp_path / name, TEXTS[name])
        size = next(iter(read_cameras(path).values())).image_size
        assert read_cameras(path, image_size=size)
        with pytest.raises(ArgumentError, match=rf"image_size: .*{name} says itself"):
            read_cameras(path, image_size=(size[0] // 2, size[1] // 2))


@pytest.mark.parametrize(("size", "said"), [((240, 320), "another size"), ((960, 720), "exchanged")])
def test_a_principal_point_far_from_the_middle_is_told(
    tmp_path: Path, size: tuple[int, int], said: str
) -> None:
    path = dump(
        tmp_path / "camera.yaml", {"camera_matrix": [[600.0, 0, 480.0], [0, 600.0, 360.0], [0, 0, 1.0]]}
    )
    with pytest.warns(UserWarning, match=said):
        read_camera(path, image_size=size)


# What other programs read and write -----------------------------------------------------------------------------------


def test_orbslam_reads_what_is_written_for_it(tmp_path: Path) -> None:
    """Its parser is OpenCV's FileStorage, which wants its keys, types and matrices as they are."""
    camera = KannalaBrandtCamera(
        [190.5, 190.25], [254.75, 256.5], [0.5, 0.25, -0.125, 0.0625], (512, 640), 1.5
    )
    pose = torch.tensor(RIGHT_OF_FIRST)
    rig = CameraRig([camera, camera], torch.stack((torch.eye(4), pose)))
    save_rig(rig, tmp_path / "settings.yaml", "orbslam")
    storage = cv2.FileStorage(str(tmp_path / "settings.yaml"), cv2.FILE_STORAGE_READ)
    root = storage.root()
    found = {key: storage.getNode(key) for key in root.keys()}  # noqa: SIM118  # no mapping
    assert found["Camera.type"].string() == "KannalaBrandt8"
    assert [found[f"Camera2.{key}"].real() for key in ("fx", "cy", "k3")] == [190.25 + 0.25, 256.5, -0.125]
    assert (found["Camera.width"].real(), found["Camera.height"].real()) == (640, 512)
    np.testing.assert_array_equal(found["Stereo.T_c1_c2"].mat(), pose.double().numpy())


def test_the_script_of_the_documentation_writes_what_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With objects in place of Blender's; its panoramic settings are the camera's, or those of Cycles as they were."""
    page = (Path(__file__).resolve().parents[2] / "docs/formats/blender.md").read_text()
    script = page.split('```python title="export_cameras.py"')[1].split("```")[0]
    values = sample("blender.json")["cameras"]["fisheye_equisolid"]
    frame = {key: values[key] for key in values if key.startswith("resolution")}
    render = SimpleNamespace(**frame, pixel_aspect_x=1.0, pixel_aspect_y=1.0)
    pano = {key: value for key, value in values.items() if "fisheye" in key or "pano" in key}
    plain = {key: value for key, value in values.items() if key not in (*pano, *frame, "matrix_world")}
    lenses = (SimpleNamespace(**plain, **pano), SimpleNamespace(**plain, cycles=SimpleNamespace(**pano)))
    objects = [
        SimpleNamespace(type="CAMERA", name=name, data=data, matrix_world=values["matrix_world"])
        for name, data in zip(("new", "old"), lenses, strict=True)
    ]
    bpy = SimpleNamespace(
        context=SimpleNamespace(scene=SimpleNamespace(render=render)),
        data=SimpleNamespace(objects=[*objects, SimpleNamespace(type="LIGHT")]),
        path=SimpleNamespace(abspath=lambda name: str(tmp_path / name.removeprefix("//"))),
    )
    monkeypatch.setitem(sys.modules, "bpy", bpy)
    exec(compile(script, "export_cameras.py", "exec"), {})
    cameras = read_cameras(tmp_path / "blender.json")
    expected = read_camera(dump(tmp_path / "a.json", sample("blender.json")), "fisheye_equisolid")
    assert list(cameras) == ["new", "old"]
    assert all(camera.equals(expected) for camera in cameras.values())
