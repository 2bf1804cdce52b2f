# SPDX-License-Identifier: Apache-2.0
"""Blender's cameras, py-OCamCalib's json and RealityCapture's XMP against their formulas, written once more."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sphericalvision.cameras import (
    AnglePolynomialCamera,
    EquirectangularCamera,
    OCamCamera,
    PinholeCamera,
    read_camera,
    read_cameras,
    read_rig,
)
from sphericalvision.core import ArgumentError, FileFormatError
from tests.cameras.calibration_samples import (
    REALITY_CAPTURE,
    assert_projects,
    blender,
    directions,
    dump,
    opencv_plain,
    py_ocamcalib,
)

PLACES = np.stack(np.meshgrid(np.linspace(0.2, 0.8, 9), np.linspace(0.2, 0.8, 7)), -1).reshape(-1, 2)
"""Across and up the frame, from its lower left corner, as Blender measures."""


def rays_of_blender(kind: str, values: dict[str, float]) -> np.ndarray:
    """Cycles' projections: rays (right, down, forward) of ``PLACES``."""
    lens, view = values["fisheye_lens"], values["fisheye_fov"]
    x, y = ((PLACES - 0.5) * 2 if "EQUIDISTANT" in kind else (PLACES - 0.5) * [36.0, 22.5]).T
    r = np.hypot(x, y)
    if kind == "FISHEYE_EQUIDISTANT":
        theta = r * view / 2
    elif kind == "FISHEYE_EQUISOLID":
        theta = 2 * np.arcsin(r / (2 * lens))
    else:
        theta = -sum(values[f"fisheye_polynomial_k{power}"] * r**power for power in range(1, 5))
    assert (theta < view / 2).all()
    return np.stack((np.sin(theta) * x / r, -np.sin(theta) * y / r, np.cos(theta)), -1)


def pixels_of_places(width: int = 640, height: int = 400) -> np.ndarray:
    return np.stack((PLACES[:, 0] * width - 0.5, (1 - PLACES[:, 1]) * height - 0.5), -1)


@pytest.mark.parametrize("kind", ["FISHEYE_EQUIDISTANT", "FISHEYE_EQUISOLID", "FISHEYE_LENS_POLYNOMIAL"])
def test_blender_fisheyes_are_those_of_cycles(tmp_path: Path, kind: str) -> None:
    content = blender()
    values = content["cameras"][kind.lower()]
    camera = read_camera(dump(tmp_path / "blender.json", content), kind.lower(), dtype=torch.float64)
    with np.errstate(invalid="ignore"):
        rays = rays_of_blender(kind, values)
    off_axis = np.isfinite(rays).all(-1)
    assert_projects(camera, pixels_of_places()[off_axis], rays[off_axis], tolerance=1e-8)
    assert 1.3 < float(camera.max_angle) < 1.4 + 1e-12


def test_blender_pinhole_panorama_and_poses(tmp_path: Path) -> None:
    rig = read_rig(dump(tmp_path / "blender.json", blender()), dtype=torch.float64)
    plain, whole = rig.cameras["plain"], rig.cameras["equirectangular"]
    assert isinstance(whole, EquirectangularCamera)
    assert whole.edges == "sphere"
    part = {**blender()["cameras"]["equirectangular"], "latitude_min": -0.2, "longitude_max": 1.0}
    camera = read_camera(dump(tmp_path / "part.json", {"cameras": {"part": part}}))
    assert camera.latitudes == pytest.approx((-0.2, math.pi / 2))
    assert camera.longitudes == pytest.approx((-math.pi, 1.0))
    assert isinstance(plain, PinholeCamera)
    assert plain.focal_length.tolist() == pytest.approx([30 / 36 * 640] * 2)
    assert rig.positions[0].tolist() == [0.5, 0.2, 1.6]
    torch.testing.assert_close(rig.axes[0], torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))


def test_the_script_of_the_documentation_writes_what_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With objects in place of Blender's; its panoramic settings are the camera's, or those of Cycles as they were."""
    page = (Path(__file__).resolve().parents[2] / "docs/formats/blender.md").read_text()
    script = page.split('```python title="export_cameras.py"')[1].split("```")[0]
    values = blender()["cameras"]["fisheye_equisolid"]
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
    expected = read_camera(dump(tmp_path / "a.json", blender()), "fisheye_equisolid")
    assert list(cameras) == ["new", "old"]
    assert all(camera.equals(expected) for camera in cameras.values())


def test_blender_sensor_fits_the_side_that_it_is_told(tmp_path: Path) -> None:
    """A portrait picture: the sensor's width is its height, or the sensor's height is; the shift moves the picture."""
    for fit, focal_length in (
        ("AUTO", 30 / 36 * 900),
        ("HORIZONTAL", 30 / 36 * 600),
        ("VERTICAL", 30 / 24 * 900),
    ):
        sides = {"resolution_x": 600, "resolution_y": 900, "resolution_percentage": 100}
        values = blender(**sides, sensor_fit=fit, shift_y=0.1)["cameras"]["plain"]
        camera = read_camera(dump(tmp_path / "blender.json", {"cameras": {"plain": values}}))
        assert isinstance(camera, PinholeCamera)
        assert camera.focal_length.tolist() == pytest.approx([focal_length] * 2)
        side = 600 if fit == "HORIZONTAL" else 900
        assert camera.principal_point.tolist() == pytest.approx([299.5, 449.5 + 0.1 * side])


def test_py_ocamcalib_looks_along_the_rays_of_its_program(tmp_path: Path) -> None:
    """Its cam2world: the centre off, the stretch undone, (x, y, f(ρ))."""
    content = py_ocamcalib()
    camera = read_camera(dump(tmp_path / "c.json", content), image_size=(240, 320), dtype=torch.float64)
    assert isinstance(camera, OCamCamera)
    pixels = np.stack(np.meshgrid(np.linspace(3, 316, 9), np.linspace(2, 236, 8)), -1).reshape(-1, 2)
    x, y = np.linalg.solve(content["stretch_matrix"], (pixels - content["distortion_center"]).T)
    z = np.polyval(content["taylor_coefficient"][::-1], np.hypot(x, y))
    rays = np.stack((x, y, z), -1) / np.sqrt(x * x + y * y + z * z)[:, None]
    found, valid = camera.unproject(torch.from_numpy(pixels))
    assert valid.all()
    np.testing.assert_allclose(found.numpy(), rays, atol=1e-12)
    assert_projects(camera, pixels, rays, tolerance=1e-8)
    assert list(read_cameras(tmp_path / "c.json", image_size=(240, 320))) == ["fisheye_1"]


def test_py_ocamcalib_needs_a_size_and_a_forward_polynomial(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match=r"image_size: .*does not tell it"):
        read_camera(dump(tmp_path / "c.json", py_ocamcalib()))
    for changes, message in (
        ({"taylor_coefficient": [-337.0, 0.0, 1e-3]}, "taylor_coefficient: expected the first one above 0"),
        ({"stretch_matrix": [[1.0, 0.0]]}, "stretch_matrix: expected "),
    ):
        with pytest.raises(FileFormatError, match=message):
            read_camera(dump(tmp_path / "c.json", py_ocamcalib(**changes)), image_size=(240, 320))


def test_realitycapture_is_brown_in_units_of_the_longer_side(tmp_path: Path) -> None:
    (tmp_path / "a.xmp").write_text(REALITY_CAPTURE)
    (tmp_path / "b.xmp").write_text(REALITY_CAPTURE.replace(">1.5 ", ">1.75 "))
    rig = read_rig(tmp_path, image_size=(480, 640), dtype=torch.float64)
    assert rig.names == ["a", "b"]
    f = 24.5 * 640 / 36
    matrix = [[f, 0, 320 - 0.0046 * 640 - 0.5], [0, f * 1.001, 240 + 0.0082 * 640 - 0.5], [0, 0, 1]]
    rays = directions(30.0)
    k1, k2, k3, t1, t2 = -0.124, 0.107, -0.0105, 0.0011, -0.0007
    assert_projects(rig.cameras["a"], opencv_plain(rays, matrix, [k1, k2, t2, t1, k3]), rays)
    assert rig.positions[1].tolist() == [1.75, -0.25, 0.75]
    rows = torch.tensor([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(
        rig.world_from_camera[0, :3, :3], rows.T
    )  # the file's takes the world to the camera


def test_angle_polynomial_is_the_inverse_of_its_formula() -> None:
    """At image radius ρ the angle is the polynomial's, past 90° and up to where it stops growing."""
    k = [-0.004, 0.03, -0.002, 0.0005]
    camera = AnglePolynomialCamera(
        torch.tensor([100.0, 110.0], dtype=torch.float64), [499.5, 299.5], k, (600, 1000)
    )
    radius = np.linspace(0.0, 1.9, 40)
    theta = radius * (1 + sum(c * radius**power for power, c in enumerate(k, start=1)))
    assert theta[-1] > np.radians(110)
    azimuth = np.arange(40) * 2.4
    rays = np.stack((np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)), -1)
    pixels = np.stack((100 * radius * np.cos(azimuth) + 499.5, 110 * radius * np.sin(azimuth) + 299.5), -1)
    assert_projects(camera, pixels, rays, tolerance=1e-9)
    folding = AnglePolynomialCamera([100.0, 100.0], [0.0, 0.0], [0.0, -1 / 3], (600, 1000))
    assert float(folding.max_angle) == pytest.approx(2 / 3, abs=1e-6)  # ρ − ρ³/3 at ρ = 1
