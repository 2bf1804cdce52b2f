# SPDX-License-Identifier: Apache-2.0
"""COLMAP's cameras.txt: nine models, and half a pixel between its convention and this package's."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sphericalvision.cameras import (
    BrownConradyCamera,
    Camera,
    CameraRig,
    EquirectangularCamera,
    ExtendedUnifiedCamera,
    FisheyeCamera,
    read_camera,
    read_cameras,
    read_rig,
    save_camera,
    save_rig,
)
from sphericalvision.cameras.calibration import write_colmap
from sphericalvision.core import FileFormatError, MissingFileError
from sphericalvision.geometry import transform_from_axis_angle
from tests.cameras.calibration_samples import TEXTS, assert_projects, directions, dump
from tests.laws.cameras import MODELS


def test_convention_colmap_pixel_centers_are_half_a_pixel_further(tmp_path: Path) -> None:
    """The optical axis of a centred lens: (160, 120) there, (159.5, 119.5) here, for an image of 320 x 240."""
    camera = read_camera(dump(tmp_path / "cameras.txt", "1 SIMPLE_PINHOLE 320 240 300 160 120\n"))
    assert camera.project(torch.tensor([0.0, 0.0, 1.0])).pixels.tolist() == [159.5, 119.5]


def test_cameras_are_read_back_as_written(tmp_path: Path) -> None:
    cameras = read_cameras(dump(tmp_path / "source.txt", TEXTS["cameras.txt"]), dtype=torch.float64)
    write_colmap(cameras, tmp_path / "cameras.txt")
    again = read_cameras(tmp_path / "cameras.txt", dtype=torch.float64)
    assert list(again) == list(cameras)
    assert all(again[name].equals(camera) for name, camera in cameras.items())


def test_distortion_is_written_as_the_smallest_model_that_holds_it(tmp_path: Path) -> None:
    for distortion, model in (
        ([0.1, 0.02, 0.0, 0.0, 0.0], "OPENCV"),
        ([0.1, 0.02, 0.0, 0.0, 0.01], "FULL_OPENCV"),
        ([0.1, 0.02, 0.0, 0.0, 0.01, 0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], "FULL_OPENCV"),
    ):
        camera = BrownConradyCamera([300.0, 300.0], [159.5, 119.5], distortion, (240, 320))
        save_camera(camera, tmp_path / "cameras.txt", format="colmap")
        assert (tmp_path / "cameras.txt").read_text().splitlines()[1].split()[1] == model


NEWER = """1 EUCM 320 240 120 121 160 120 0.6 1.1
2 FISHEYE 320 240 120 121 160 120
3 SIMPLE_FISHEYE 320 240 120 160 120
4 EQUIRECTANGULAR 320 160 320 160
"""


def test_newer_models_are_those_that_the_library_has(tmp_path: Path) -> None:
    found = list(read_cameras(dump(tmp_path / "cameras.txt", NEWER), dtype=torch.float64).values())
    assert isinstance(found[0], ExtendedUnifiedCamera)
    assert (found[0].alpha.item(), found[0].beta.item()) == (0.6, 1.1)
    assert isinstance(found[1], FisheyeCamera)
    assert isinstance(found[2], FisheyeCamera)
    assert found[2].focal_length.tolist() == [120.0, 120.0]
    assert found[3].equals(EquirectangularCamera((160, 320)).to(torch.float64))


def colmap_lenses() -> dict[str, Camera]:
    """One of each model that COLMAP has."""
    names = (
        "pinhole",
        "kannala brandt",
        "atan",
        "division",
        "extended unified",
        "equidistant",
        "brown conrady",
    )
    names += ("thin prism fisheye", "equirectangular")
    return {f"cam{i}": MODELS[name](1.0).to(torch.float64) for i, name in enumerate(names, start=3)}


def rig_of_all() -> CameraRig:
    lenses = colmap_lenses()
    generator = torch.Generator().manual_seed(3)
    turns, shifts = torch.randn(2, len(lenses), 3, generator=generator, dtype=torch.float64) * 0.4
    return CameraRig(lenses, transform_from_axis_angle(turns, shifts))


@pytest.mark.parametrize("suffix", [".txt", ".bin"])
def test_rigs_keep_every_digit(tmp_path: Path, suffix: str) -> None:
    rig = rig_of_all()
    save_rig(rig, tmp_path / f"cameras{suffix}", "colmap")
    again = read_rig(tmp_path, dtype=torch.float64)
    assert again.names == rig.names
    relative = [r.camera_from_world[:1] @ r.world_from_camera for r in (rig, again)]
    torch.testing.assert_close(relative[1], relative[0], rtol=0, atol=1e-12)
    images = read_rig(tmp_path / f"images{suffix}", dtype=torch.float64)
    torch.testing.assert_close(images.world_from_camera, rig.world_from_camera, rtol=0, atol=1e-12)
    for name, camera in rig.cameras.items():
        assert type(again.cameras[name]) is type(camera)
    cameras = read_cameras(tmp_path, dtype=torch.float64)
    assert list(cameras) == rig.names


@pytest.mark.parametrize("suffix", [".txt", ".bin"])
def test_colmap_itself_reads_what_is_written(tmp_path: Path, suffix: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    rig = rig_of_all()
    save_rig(rig, tmp_path / f"cameras{suffix}", "colmap")
    model = pycolmap.Reconstruction(str(tmp_path))
    assert (model.num_cameras(), model.num_rigs(), model.num_reg_images()) == (len(rig), 1, len(rig))
    rays = directions(40.0)[1:]
    for image in model.images.values():
        name = Path(image.name).stem
        place = rig.names.index(name)
        pose = image.cam_from_world().matrix()
        np.testing.assert_allclose(pose, rig.camera_from_world[place, :3].numpy(), atol=1e-9)
        pixels = np.stack([model.cameras[image.camera_id].img_from_cam(ray) for ray in rays]) - 0.5
        assert_projects(rig.cameras[name], pixels, rays, 1e-8)


def test_a_model_that_colmap_wrote(tmp_path: Path) -> None:
    """Text and binary of one reconstruction, with points on an image, are the same rig."""
    pycolmap = pytest.importorskip("pycolmap")
    save_rig(rig_of_all(), tmp_path / "ours.txt", "colmap")
    model = pycolmap.Reconstruction(str(tmp_path))
    next(iter(model.images.values())).points2D = pycolmap.Point2DList(
        [pycolmap.Point2D(np.array([3.0, 4.0]))] * 3
    )
    rigs = []
    for kind in ("text", "binary"):
        (tmp_path / kind).mkdir()
        getattr(model, f"write_{kind}")(str(tmp_path / kind))
        rigs.append(read_rig(tmp_path / kind, dtype=torch.float64))
        images = read_rig(tmp_path / kind / f"images.{kind[:3].replace('tex', 'txt')}", dtype=torch.float64)
        assert len(images) == len(rigs[0])
    assert all(rigs[1].cameras[name].equals(camera) for name, camera in rigs[0].cameras.items())
    torch.testing.assert_close(rigs[0].world_from_camera, rigs[1].world_from_camera, rtol=0, atol=1e-12)


def test_images_without_rigs_are_a_rig_of_images(tmp_path: Path) -> None:
    """Two images of one camera; empty lines, and one of points, between them; names may have spaces."""
    dump(tmp_path / "cameras.txt", "7 PINHOLE 320 240 300 300 160 120\n")
    half = 0.5**0.5
    lines = [
        "# Number of images: 3, mean observations per image: 0",
        "1 1 0 0 0 0 0 0 7 left/a b.png",
        *("", "", ""),
        f"2 {half} 0 {-half} 0 0 0 -0.5 7 right/c.png",
        "1 2 -1",
    ]
    dump(tmp_path / "images.txt", "\n".join(lines) + "\n")
    with pytest.warns(UserWarning, match=r"images\.txt: its head says 3 images, there are 2"):
        rig = read_rig(tmp_path, dtype=torch.float64)
    assert rig.names == ["left/a b", "right/c"]
    torch.testing.assert_close(rig.axes[1], torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(rig.positions[1], torch.tensor([0.5, 0.0, 0.0], dtype=torch.float64))
    assert list(read_cameras(tmp_path)) == ["cam7"]
    (tmp_path / "cameras.txt").unlink()
    with pytest.raises(MissingFileError, match=r"the cameras of images\.txt"):
        read_rig(tmp_path / "images.txt")


@pytest.fixture(scope="module")
def binaries() -> dict[str, bytes]:
    with tempfile.TemporaryDirectory() as folder:
        save_rig(rig_of_all(), Path(folder) / "cameras.bin", "colmap")
        return {path.name: path.read_bytes() for path in Path(folder).glob("*.bin")}


@given(data=st.data())
@settings(max_examples=40, deadline=None)
def test_a_part_of_a_binary_file_is_refused(data: st.DataObject, binaries: dict[str, bytes]) -> None:
    name = data.draw(st.sampled_from(["cameras.bin", "images.bin", "rigs.bin"]))
    with tempfile.TemporaryDirectory() as folder:
        for other, content in binaries.items():
            (Path(folder) / other).write_bytes(content)
        (Path(folder) / name).write_bytes(
            binaries[name][: data.draw(st.integers(0, len(binaries[name]) - 1))]
        )
        with pytest.raises(FileFormatError, match=name):
            read_rig(Path(folder) / name, max_angle=0.5)


def test_rigs_that_say_too_little_are_refused(tmp_path: Path) -> None:
    dump(tmp_path / "cameras.txt", "1 PINHOLE 320 240 300 300 160 120\n2 PINHOLE 320 240 300 300 160 120\n")
    for line, message in (
        ("1 2 CAMERA 1 CAMERA 2 0", "camera 2 has no pose in the rig"),
        ("1 2 CAMERA 1 CAMERA 3 1 1 0 0 0 0 0 0", "expected a number of a camera, got 3"),
        ("1 2 CAMERA 1 CAMERA 2 1 1 0 0 0", "the line is too short"),
        ("1 3 CAMERA 1 CAMERA 2 1 1 0 0 0 0 0 0", "the line is too short"),
        ("1 2 CAMERA 1 LIDAR 2 0", "expected CAMERA or IMU, got 'LIDAR'"),
        ("1 1", "expected SENSOR_TYPE SENSOR_ID, the line is too short"),
        ("1 1 CAMERA 1", "expected one rig of several cameras, got 0"),
        ("1 2 CAMERA 1 CAMERA 2 1 2 0 0 0 0 0 0", "expected a quaternion of length 1"),
    ):
        dump(tmp_path / "rigs.txt", line + "\n")
        with pytest.raises(FileFormatError, match=rf"rigs\.txt.*{message}"):
            read_rig(tmp_path / "rigs.txt")
    dump(tmp_path / "frames.txt", "1 1 1 0 0 0 0 0 0 0\n")
    with pytest.raises(FileFormatError, match="read the folder"):
        read_rig(tmp_path / "frames.txt")
