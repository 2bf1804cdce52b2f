# SPDX-License-Identifier: Apache-2.0
"""Project Aria's json and Metashape's XML against their formulas, written once more."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sphericalvision.cameras import (
    EquirectangularCamera,
    ThinPrismFisheyeCamera,
    read_camera,
    read_cameras,
    read_rig,
)
from sphericalvision.core import ArgumentError, FileFormatError
from tests.cameras.calibration_samples import (
    aria,
    assert_projects,
    directions,
    dump,
)


def fisheye624(rays: np.ndarray, params: list[float]) -> np.ndarray:
    """As its header file says it: radial, then tangential and thin prism of the distorted point."""
    f, cx, cy, *more = params
    k, (p0, p1), (s0, s1, s2, s3) = more[:6], more[6:8], more[8:]
    x, y, z = rays.T
    radius = np.hypot(x, y)
    theta = np.arctan2(radius, z)
    grown = theta * (1 + sum(c * theta ** (2 * i) for i, c in enumerate(k, start=1)))
    scale = grown / np.where(radius > 0, radius, 1)
    xr, yr = x * scale, y * scale
    r2 = xr * xr + yr * yr
    dot = 2 * (xr * p0 + yr * p1)
    u = xr + dot * xr + r2 * p0 + s0 * r2 + s1 * r2 * r2
    v = yr + dot * yr + r2 * p1 + s2 * r2 + s3 * r2 * r2
    return np.stack((f * u + cx, f * v + cy), -1)


def test_aria_cameras_are_fisheye624(tmp_path: Path) -> None:
    rig = read_rig(dump(tmp_path / "device.json", aria()), dtype=torch.float64)
    assert rig.names == ["camera-slam-left", "camera-rgb"]
    rays = directions(60.0)
    camera = rig.cameras["camera-slam-left"]
    assert isinstance(camera, ThinPrismFisheyeCamera)
    assert camera.image_size == (480, 640)
    params = aria()["CameraCalibrations"][0]["Projection"]["Params"]
    assert_projects(camera, fisheye624(rays, params), rays)


def test_aria_sizes_are_those_of_the_sensors_or_given(tmp_path: Path) -> None:
    content = aria()
    assert read_cameras(dump(tmp_path / "a.json", content), image_size=(240, 320))[
        "camera-rgb"
    ].image_size == (240, 320)
    content["CameraCalibrations"][0]["Label"] = "left"
    with pytest.raises(ArgumentError, match=r"image_size: .*'left'"):
        read_cameras(dump(tmp_path / "a.json", content))
    content["CameraCalibrations"][0]["Projection"]["Name"] = "Linear"
    with pytest.raises(FileFormatError, match=r"\[0\], Projection, Name: expected FisheyeRadTanThinPrism"):
        read_cameras(dump(tmp_path / "a.json", content))


LENS = "<f>300</f><cx>3.5</cx><cy>-2.25</cy><k1>-0.1</k1><k2>0.02</k2><k3>-0.001</k3><p1>0.001</p1><p2>-0.002</p2>"
SIZE = '<resolution width="640" height="480"/>'
CALIBRATION = "<?xml version='1.0'?><calibration>"
CALIBRATION += f"<projection>frame</projection><width>640</width><height>480</height>{LENS}"
CALIBRATION += "<b1>0.5</b1><b2>0.25</b2></calibration>"
CHUNK = f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="1.5.0"><chunk label="Chunk 1">
<sensors>
<sensor id="0" type="frame">{SIZE}<calibration type="frame" class="initial">{SIZE}<f>290</f></calibration>
<calibration type="frame" class="adjusted">{SIZE}{LENS}</calibration></sensor>
<sensor id="1" type="fisheye">{SIZE}<calibration type="fisheye" class="adjusted">{SIZE}{LENS}
<k4>0.003</k4></calibration></sensor>
<sensor id="2" type="spherical"><resolution width="640" height="320"/><calibration type="spherical"/></sensor>
</sensors>
<cameras>
<camera id="0" sensor_id="0" label="DSC_1"><transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera>
<camera id="1" sensor_id="1" label="DSC_2"><transform>0 0 1 0.2 0 1 0 0 -1 0 0 0 0 0 0 1</transform></camera>
<camera id="2" sensor_id="0" label="lost"/>
</cameras>
<transform><scale>0.5</scale></transform>
</chunk></document>
"""


def metashape(rays: np.ndarray, fisheye: bool, k4: float = 0.0, b1: float = 0.0, b2: float = 0.0) -> Any:
    """The manual's appendix: x' = x (1 + ...) + P1 (r² + 2x²) + 2 P2 x y, u = w/2 + cx + x' (f + B1) + y' B2."""
    x, y, z = rays.T
    x, y = x / z, y / z
    if fisheye:
        r0 = np.hypot(x, y)
        x, y = (c * np.arctan(r0) / np.where(r0 > 0, r0, 1) for c in (x, y))
    r2 = x * x + y * y
    growth = 1 - 0.1 * r2 + 0.02 * r2**2 - 0.001 * r2**3 + k4 * r2**4
    u = x * growth + 0.001 * (r2 + 2 * x * x) - 2 * 0.002 * x * y
    v = y * growth - 0.002 * (r2 + 2 * y * y) + 2 * 0.001 * x * y
    return np.stack((320 + 3.5 + u * (300 + b1) + v * b2 - 0.5, 240 - 2.25 + v * 300 - 0.5), -1)


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_metashape_formulas(tmp_path: Path) -> None:
    rays = directions(35.0)
    alone = read_camera(written(tmp_path / "lens.xml", CALIBRATION), dtype=torch.float64)
    assert_projects(alone, metashape(rays, fisheye=False, b1=0.5, b2=0.25), rays)
    cameras = read_cameras(written(tmp_path / "cameras.xml", CHUNK), dtype=torch.float64)
    assert_projects(cameras["cam0"], metashape(rays, fisheye=False), rays)
    assert_projects(cameras["cam1"], metashape(rays, fisheye=True, k4=0.003), rays)
    assert isinstance(cameras["cam2"], EquirectangularCamera)


def test_sensors_of_metashape_without_a_calibration(tmp_path: Path) -> None:
    """A spherical one has nothing to calibrate; one of another kind is of images that were not aligned."""
    sensor = (
        '<sensor id="3" label="new" type="TYPE"><resolution width="1920" height="960"/></sensor></sensors>'
    )
    pose = "<transform>1 0 0 0.5 0 1 0 0 0 0 1 0 0 0 0 1</transform>"
    photo = f'<camera id="3" sensor_id="3" label="pano">{pose}</camera>'
    whole = CHUNK.replace("</sensors>", sensor.replace("TYPE", "spherical"))
    rig = read_rig(written(tmp_path / "sphere.xml", whole.replace("</cameras>", f"{photo}</cameras>")))
    assert isinstance(rig.cameras["pano"], EquirectangularCamera)
    assert rig.cameras["pano"].image_size == (960, 1920)
    unused = CHUNK.replace("</sensors>", sensor.replace("TYPE", "frame"))
    assert read_rig(written(tmp_path / "unused.xml", unused)).names == ["DSC_1", "DSC_2"]
    with pytest.raises(FileFormatError, match=r"camera 'pano': .* sensor"):
        read_rig(written(tmp_path / "used.xml", unused.replace("</cameras>", f"{photo}</cameras>")))


def test_metashape_cameras_are_called_by_their_labels(tmp_path: Path) -> None:
    rig = read_rig(written(tmp_path / "cameras.xml", CHUNK), dtype=torch.float64)
    assert rig.names == ["DSC_1", "DSC_2"]
