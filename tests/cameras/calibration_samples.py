# SPDX-License-Identifier: Apache-2.0
"""Small calibrations of every format, typed in, and the projections they stand for, written down a second time."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import yaml
from torch import Tensor

from sphericalvision.cameras import Camera
from sphericalvision.core import ArgumentError

HALF = 0.5**0.5
QUARTER_TURN = [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
"""Takes what is right of the first camera to the front of the second."""


DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # ten times as fast, where libyaml is there


def dumped(content: Any, name: str) -> str:
    """Keys with values as JSON or YAML, by the name of the file."""
    return json.dumps(content) if name.endswith("json") else yaml.dump(content, None, DUMPER, sort_keys=False)


def dump(path: Path, content: Any) -> Path:
    """Write keys with values as JSON or YAML."""
    path.write_text(dumped(content, path.name))
    return path


def with_size(read: Callable[..., Any], path: Path, **known: Any) -> Any:
    """What ``read`` reads, with a size of the images only where the file does not tell one."""
    try:
        return read(path, **known)
    except ArgumentError as error:
        if "does not tell" not in str(error) or not str(error).startswith("image_size"):
            raise
        return read(path, image_size=(240, 320), **known)


def double(*values: Any) -> list[Tensor]:
    """Each as a tensor in float64."""
    return [torch.tensor(value, dtype=torch.float64) for value in values]


def circle(angle: Tensor, azimuth: float = 0.7) -> Tensor:
    """Unit vectors (*, 3) at angles (*) from the axis."""
    flat = angle.sin()
    return torch.stack((flat * math.cos(azimuth), flat * math.sin(azimuth), angle.cos()), -1)


def published() -> Path:
    """Calibrations that others publish; they are not part of this package."""
    default = Path(__file__).resolve().parents[2].parent / "shared" / "real"
    folder = Path(os.environ.get("SPHERICALVISION_REAL", default)) / "calibrations"
    if not folder.is_dir():
        pytest.skip("published calibrations not found; set SPHERICALVISION_REAL to the folder that has them")
    return folder


def directions(max_degrees: float = 60.0, rings: int = 7, spokes: int = 12) -> np.ndarray:
    """Unit vectors (n, 3) from the axis out to an angle."""
    angle = np.radians(np.linspace(0.0, max_degrees, rings))[:, None]
    around = np.linspace(0.0, 2 * np.pi, spokes, endpoint=False)
    rays = (np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle) + 0 * around)
    return np.stack(rays, -1).reshape(-1, 3)


def assert_projects(camera: Camera, expected: np.ndarray, rays: np.ndarray, tolerance: float = 1e-9) -> None:
    """The camera, read in double precision, sees ``rays`` at the ``expected`` pixels."""
    pixels = camera.project(torch.from_numpy(rays)).pixels.numpy()
    np.testing.assert_allclose(pixels, expected, rtol=0, atol=tolerance)


# Projections, each written from its definition and away from the package ----------------------------------------------


def opencv_plain(rays: np.ndarray, matrix: Any, distortion: Any) -> np.ndarray:
    zero = np.zeros(3)
    points = cv2.projectPoints(
        rays[:, None], zero, zero, np.array(matrix, float), np.array(distortion, float)
    )
    return points[0].reshape(-1, 2)


def opencv_fisheye(rays: np.ndarray, matrix: Any, distortion: Any) -> np.ndarray:
    zero = np.zeros(3)
    points = cv2.fisheye.projectPoints(
        rays[:, None], zero, zero, np.array(matrix, float), np.array(distortion, float)
    )
    return points[0].reshape(-1, 2)


def opencv_omnidir(rays: np.ndarray, matrix: Any, xi: float, distortion: Any) -> np.ndarray:
    zero = np.zeros((1, 3))
    points = cv2.omnidir.projectPoints(
        rays[:, None], zero, zero, np.array(matrix, float), xi, np.array(distortion, float)
    )
    return points[0].reshape(-1, 2)


def double_sphere(
    rays: np.ndarray, fx: float, fy: float, cx: float, cy: float, xi: float, alpha: float
) -> Any:
    x, y, z = rays.T
    first = np.sqrt(x * x + y * y + z * z)
    second = np.sqrt(x * x + y * y + (xi * first + z) ** 2)
    below = alpha * second + (1 - alpha) * (xi * first + z)
    return np.stack((fx * x / below + cx, fy * y / below + cy), -1)


def extended_unified(
    rays: np.ndarray, fx: float, fy: float, cx: float, cy: float, alpha: float, beta: float
) -> Any:
    x, y, z = rays.T
    below = alpha * np.sqrt(beta * (x * x + y * y) + z * z) + (1 - alpha) * z
    return np.stack((fx * x / below + cx, fy * y / below + cy), -1)


def kannala_brandt(rays: np.ndarray, fx: float, fy: float, cx: float, cy: float, *k: float) -> Any:
    """Past 90° too, where ``cv2.fisheye`` is not right."""
    x, y, z = rays.T
    radius = np.hypot(x, y)
    theta = np.arctan2(radius, z)
    stretched = theta * (1 + sum(c * theta ** (2 * i) for i, c in enumerate(k, start=1)))
    scale = stretched / np.where(radius > 0, radius, 1)
    return np.stack((fx * x * scale + cx, fy * y * scale + cy), -1)


# Files ----------------------------------------------------------------------------------------------------------------

KALIBR: dict[str, dict[str, Any]] = {
    "pinhole none": {"camera_model": "pinhole", "intrinsics": [300.5, 301.0, 159.25, 120.75]},
    "pinhole radtan": {
        "camera_model": "pinhole",
        "intrinsics": [461.6, 460.2, 362.7, 246.0],
        "distortion_model": "radtan",
        "distortion_coeffs": [-0.277, 0.067, 0.00088, 0.00012],
        "resolution": [752, 480],
    },
    "pinhole equidistant": {
        "camera_model": "pinhole",
        "intrinsics": [190.98, 190.97, 254.93, 256.9],
        "distortion_model": "equidistant",
        "distortion_coeffs": [0.0035, 0.0007, -0.002, 0.0002],
        "resolution": [512, 512],
    },
    "omni none": {"camera_model": "omni", "intrinsics": [1.2, 400.0, 401.0, 320.5, 240.25]},
    "omni radtan": {
        "camera_model": "omni",
        "intrinsics": [0.8, 833.0, 830.3, 373.85, 253.75],
        "distortion_model": "radtan",
        "distortion_coeffs": [-0.33, 0.13, 0.00056, 0.00058],
        "resolution": [752, 480],
    },
    "eucm none": {"camera_model": "eucm", "intrinsics": [0.63, 1.04, 191.1, 191.2, 254.96, 256.88]},
    "ds none": {"camera_model": "ds", "intrinsics": [-0.17, 0.593, 158.3, 158.2, 254.96, 256.89]},
}


def kalibr(*kinds: str, **changes: Any) -> dict[str, Any]:
    """A camchain of these cameras, each 10 cm to the right of the one before and a quarter turn further right."""
    content: dict[str, Any] = {}
    for index, kind in enumerate(kinds):
        defaults = {"distortion_model": "none", "distortion_coeffs": [], "resolution": [512, 512]}
        content[f"cam{index}"] = {**defaults, **KALIBR[kind], "rostopic": f"/cam{index}"}
        if index:
            rows = [[*row, t] for row, t in zip(QUARTER_TURN, (0.0, 0.0, -0.1), strict=True)]
            content[f"cam{index}"]["T_cn_cnm1"] = [*rows, [0.0, 0.0, 0.0, 1.0]]
    content["cam0"].update(changes)
    return content


MATRIX = [[300.5, 0.0, 159.25], [0.0, 301.0, 120.75], [0.0, 0.0, 1.0]]
FISHEYE = [[190.98, 0.0, 254.93], [0.0, 190.97, 256.9], [0.0, 0.0, 1.0]]
OMNIDIR = [[400.0, 0.0, 320.5], [0.0, 401.0, 240.25], [0.0, 0.0, 1.0]]


def opencv_yaml(**values: Any) -> str:
    """A FileStorage as OpenCV lays it out, lists of lists and plain lists being matrices."""
    lines = ["%YAML:1.0", "---"]
    for key, value in values.items():
        if isinstance(value, list):
            rows = value if isinstance(value[0], list) else [[number] for number in value]
            data = ", ".join(repr(float(number)) for row in rows for number in row)
            lines += [f"{key}: !!opencv-matrix", f"   rows: {len(rows)}", f"   cols: {len(rows[0])}"]
            lines += ["   dt: d", f"   data: [ {data} ]"]
        else:
            lines.append(f"{key}: {value}")
    return "\n".join(lines) + "\n"


def opencv_stereo(**changes: Any) -> dict[str, Any]:
    return {
        "image_width": 320,
        "image_height": 240,
        "M1": MATRIX,
        "D1": [-0.28, 0.07, 0.001, -0.002, 0.01],
        "M2": MATRIX,
        "D2": [-0.27, 0.06, 0.0, 0.0, 0.0],
        "R": QUARTER_TURN,
        "T": [0.0, 0.0, -100.0],
        **changes,
    }


COLMAP = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 9
1 SIMPLE_PINHOLE 320 240 300.5 160 120.5
2 PINHOLE 320 240 300.5 301.0 160.25 120.75
3 SIMPLE_RADIAL 320 240 300.5 160 120.5 -0.1
4 RADIAL 320 240 300.5 160 120.5 -0.1 0.02
5 OPENCV 320 240 300.5 301.0 160.25 120.75 -0.28 0.07 0.001 -0.002
6 FULL_OPENCV 320 240 300.5 301.0 160.25 120.75 0.1 0.02 0.001 -0.002 0.01 0.12 0.03 0.004
7 SIMPLE_RADIAL_FISHEYE 320 240 120.5 160 120.5 0.01
8 RADIAL_FISHEYE 320 240 120.5 160 120.5 0.01 -0.002
9 OPENCV_FISHEYE 320 240 120.5 121.0 160.25 120.75 0.01 -0.002 0.001 -0.0002
"""


def mei(**changes: Any) -> dict[str, Any]:
    """KITTI-360's ``image_02.yaml`` with rounded numbers."""
    return {
        "model_type": "MEI",
        "camera_name": "image_02",
        "image_width": 1400,
        "image_height": 1400,
        "mirror_parameters": {"xi": 2.2134},
        "distortion_parameters": {"k1": 0.0168, "k2": 1.6549, "p1": 4.2e-4, "p2": 4.3e-4},
        "projection_parameters": {"gamma1": 1336.3, "gamma2": 1335.8, "u0": 716.9, "v0": 705.8},
        **changes,
    }


def camodocal_pinhole() -> dict[str, Any]:
    return {
        "model_type": "PINHOLE",
        "image_width": 752,
        "image_height": 480,
        "distortion_parameters": {"k1": -0.277, "k2": 0.067, "p1": 0.00088, "p2": 0.00012},
        "projection_parameters": {"fx": 461.6, "fy": 460.2, "cx": 362.7, "cy": 246.0},
    }


def camodocal_kannala_brandt() -> dict[str, Any]:
    keys = ("k2", "k3", "k4", "k5", "mu", "mv", "u0", "v0")
    values = (0.0035, 0.0007, -0.002, 0.0002, 190.98, 190.97, 254.93, 256.9)
    return {
        "model_type": "KANNALA_BRANDT",
        "image_width": 512,
        "image_height": 512,
        "projection_parameters": dict(zip(keys, values, strict=True)),
    }


SCARAMUZZA = (-240.0, 0.0, 1.7e-3, -1.7e-6, 4.4e-9)
"""A panoramic annular lens: z = -(p0 + p1 r + ...)."""


def camodocal_scaramuzza(**affine: float) -> dict[str, Any]:
    inverse = (377.42, 251.31, 18.22, 20.04, 21.28, 12.43, 2.62)
    return {
        "model_type": "SCARAMUZZA",
        "camera_name": "scaramuzza",
        "image_width": 1280,
        "image_height": 960,
        "poly_parameters": {f"p{power}": value for power, value in enumerate(SCARAMUZZA)},
        "inv_poly_parameters": {f"p{power}": value for power, value in enumerate(inverse)},
        "affine_parameters": {"ac": 1.0, "ad": 0.0, "ae": 0.0, "cx": 645.1, "cy": 486.0, **affine},
    }


def stella_vslam(model: str = "fisheye", nested: bool = False) -> dict[str, Any]:
    """stella_vslam's settings of one camera."""
    distortion: dict[str, float] = {
        "fisheye": {"k1": 0.0035, "k2": 0.0007, "k3": -0.002, "k4": 2e-4},
        "perspective": {"k1": -0.28, "k2": 0.07, "p1": 2e-4, "p2": 2e-5, "k3": 0.01},
        "radial_division": {"distortion": -0.1},
    }.get(model, {})
    plane = {"fx": 190.98, "fy": 190.97, "cx": 254.93, "cy": 256.9} if distortion else {}
    camera = {
        "name": "nested" if nested else "stella",
        "setup": "monocular",
        "model": model,
        "cols": 512,
        "rows": 512 if distortion else 256,
        "fps": 20.0,
        "color_order": "RGB",
        **plane,
        **distortion,
    }
    settings = {"Preprocessing": {"min_size": 800}}
    return (
        {"Camera": camera, **settings} if nested else {f"Camera.{k}": v for k, v in camera.items()} | settings
    )


def woodscape(name: str = "FV", **changes: Any) -> dict[str, Any]:
    """A front camera: it looks along the vehicle's x, its y down being the vehicle's -z."""
    intrinsic = {
        "model": "radial_poly",
        "poly_order": 4,
        "k1": 339.7,
        "k2": -32.0,
        "k3": 48.3,
        "k4": -7.2,
        "cx_offset": 3.9,
        "cy_offset": -3.1,
        "aspect_ratio": 1.01,
        "width": 1280.0,
        "height": 966.0,
    }
    extrinsic = {"quaternion": [0.5, -0.5, 0.5, -0.5], "translation": [3.75, 0.0, 0.66]}
    return {"intrinsic": {**intrinsic, **changes}, "extrinsic": extrinsic, "name": name}


MULTICOL_C, MULTICOL_D, MULTICOL_E = 0.98, -0.0035, 0.0039


def multicol(**changes: Any) -> dict[str, Any]:
    """Like Lafida's cameras, with an affine part far enough from 1 to be noticed."""
    direct = [-209.2, 0.0, 0.00214, -4.22e-06, 1.77e-08]
    inverse = [293.7, 150.0, -10.4, 28.2, 7.1]
    return {
        "Camera.Iw": 754,
        "Camera.Ih": 480,
        "Camera.nrpol": len(direct),
        "Camera.nrinvpol": len(inverse),
        **{f"Camera.a{power}": value for power, value in enumerate(direct)},
        **{f"Camera.pol{power}": value for power, value in enumerate(inverse)},
        "Camera.c": MULTICOL_C,
        "Camera.d": MULTICOL_D,
        "Camera.e": MULTICOL_E,
        "Camera.u0": 392.2,
        "Camera.v0": 243.5,
        "Camera.mirrorMask": 1,
        **changes,
    }


def multicol_system() -> dict[str, Any]:
    """Two cameras; the second looks to the right: Cayley parameters are tan of half the angle along the axis."""
    rows = ([0.0, 0.0, 0.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, 0.1, 0.0, 0.0])
    content: dict[str, Any] = {"CameraSystem.nrCams": 2}
    for camera, row in enumerate(rows, start=1):
        content |= {f"CameraSystem.cam{camera}_{place}": value for place, value in enumerate(row, start=1)}
    return content


def basalt(*kinds: str) -> dict[str, Any]:
    """A rig of these camera types: front, then one that looks to the right."""
    center = {"cx": 254.96, "cy": 256.89}
    intrinsics = {
        "ds": {"fx": 158.3, "fy": 158.2, **center, "xi": -0.17, "alpha": 0.593},
        "eucm": {"fx": 191.1, "fy": 191.2, **center, "alpha": 0.63, "beta": 1.04},
        "ucm": {"fx": 191.1, "fy": 191.2, **center, "alpha": 0.63},
        "kb4": {"fx": 190.98, "fy": 190.97, **center, "k1": 0.0035, "k2": 0.0007, "k3": -0.002, "k4": 2e-4},
        "pinhole": {"fx": 300.5, "fy": 301.0, **center},
    }
    poses = [
        {"px": 0.0, "py": 0.0, "pz": 0.1, "qx": 0.0, "qy": 0.0, "qz": 0.0, "qw": 1.0},
        {"px": 0.1, "py": 0.0, "pz": 0.0, "qx": 0.0, "qy": HALF, "qz": 0.0, "qw": HALF},
    ]
    return {
        "value0": {
            "T_imu_cam": [poses[index % 2] for index in range(len(kinds))],
            "intrinsics": [{"camera_type": kind, "intrinsics": intrinsics[kind]} for kind in kinds],
            "resolution": [[512, 512]] * len(kinds),
        }
    }


KITTI = """calib_time: 09-Jan-2012 13:57:47
corner_dist: 9.950000e-02
S_00: 1392 512
K_00: 984.2 0.0 690.0 0.0 980.8 233.2 0.0 0.0 1.0
D_00: -0.37 0.20 0.0013 0.0017 -0.07
R_00: 1 0 0 0 1 0 0 0 1
T_00: 0 0 0
S_rect_00: 1242 375
R_rect_00: 1 0 0 0 1 0 0 0 1
P_rect_00: 721.5 0 609.6 0 0 721.5 172.9 0 0 0 1 0
S_01: 1392 512
K_01: 989.5 0.0 702.0 0.0 987.8 245.6 0.0 0.0 1.0
D_01: -0.36 0.19 0.0004 -0.0005 -0.06
R_01: 0 0 -1 0 1 0 1 0 0
T_01: 0 0 -0.537
"""


def asl(**changes: Any) -> dict[str, Any]:
    """EuRoC's ``sensor.yaml`` of a camera that looks to the right of the body."""
    rows = [[0.0, 0.0, 1.0, 0.1], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.02], [0.0, 0.0, 0.0, 1.0]]
    return {
        "sensor_type": "camera",
        "T_BS": {"cols": 4, "rows": 4, "data": [value for row in rows for value in row]},
        "rate_hz": 20,
        "resolution": [752, 480],
        "camera_model": "pinhole",
        "intrinsics": [458.6, 457.3, 367.2, 248.4],
        "distortion_model": "radial-tangential",
        "distortion_coefficients": [-0.283, 0.074, 0.00019, 1.76e-05],
        **changes,
    }


def flat(rows: Any) -> dict[str, Any]:
    """A FileStorage matrix of rows of numbers, as it is parsed."""
    data = [float(value) for row in rows for value in row]
    return {"rows": len(rows), "cols": len(rows[0]), "dt": "f", "data": data}


RIGHT_OF_FIRST = [[0.0, 0.0, 1.0, 0.11], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
"""The pose of a second camera 11 cm to the right of the first that looks to the right, in the first's frame."""


def orbslam(kind: str = "KannalaBrandt8", **changes: Any) -> dict[str, Any]:
    """ORB-SLAM3's settings of two cameras."""
    numbers = {"fx": 190.98, "fy": 190.97, "cx": 254.93, "cy": 256.9}
    distortion = {"k1": 0.0035, "k2": 0.0007, "k3": -0.002, "k4": 2e-4}
    if kind == "PinHole":
        distortion = {"k1": -0.28, "k2": 0.07, "p1": 2e-4, "p2": 2e-5}
    lens = {f"Camera{index}.{key}": v for index in (1, 2) for key, v in {**numbers, **distortion}.items()}
    size = {"Camera.width": 512, "Camera.height": 512, "Camera.fps": 20}
    stereo = {"Stereo.T_c1_c2": flat(RIGHT_OF_FIRST)}
    return {"File.version": "1.0", "Camera.type": kind, **lens, **size, **stereo, **changes}


def transforms(**changes: Any) -> dict[str, Any]:
    """Nerfstudio's file of two frames of one lens, in OpenGL's axes: one ahead, one to the right."""
    ahead = [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.1], [0.0, 0.0, 0.0, 1.0]]
    right = [[0.0, 0.0, -1.0, 0.1], [0.0, -1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    return {
        "camera_model": "OPENCV_FISHEYE",
        "w": 512,
        "h": 512,
        "fl_x": 190.98,
        "fl_y": 190.97,
        "cx": 255.43,
        "cy": 257.4,
        "k1": 0.0035,
        "k2": 0.0007,
        "k3": -0.002,
        "k4": 0.0002,
        "frames": [
            {"file_path": "images/frame_00001.jpeg", "transform_matrix": ahead},
            {"file_path": "images/frame_00002.jpeg", "transform_matrix": right},
        ],
        **changes,
    }


def aria(**changes: Any) -> dict[str, Any]:
    """Project Aria's device calibration of two cameras, with rounded numbers."""
    lens = [
        240.9,
        320.4,
        239.8,
        -0.026,
        0.103,
        -0.08,
        0.011,
        0.004,
        -0.001,
        5e-4,
        -3e-4,
        1e-3,
        -2e-4,
        -6e-4,
        1e-4,
    ]
    kinds = (("camera-slam-left", "FisheyeRadTanThinPrism", lens), ("camera-rgb", "KannalaBrandtK3", None))
    poses = (([0.0, 0.0, 0.1], [1.0, [0.0, 0.0, 0.0]]), ([0.1, 0.0, 0.02], [HALF, [0.0, HALF, 0.0]]))
    plain = [1200.5, 1201.0, 1439.5, 1440.25, 0.01, -0.02, 0.003, -0.0004]
    cameras = [
        {
            "Calibrated": True,
            "Label": label,
            "Projection": {"Name": name, "Params": params or plain},
            "T_Device_Camera": {"Translation": translation, "UnitQuaternion": quaternion},
        }
        for (label, name, params), (translation, quaternion) in zip(kinds, poses, strict=True)
    ]
    return {"CameraCalibrations": cameras, "DeviceClassInfo": {"DeviceClass": "Aria"}, **changes}


def py_ocamcalib(**changes: Any) -> dict[str, Any]:
    """py-OCamCalib's file of a lens of 185°, with rounded numbers."""
    return {
        "date": "18052022_154907",
        "camera_name": "fisheye_1",
        "valid": [True, True],
        "taylor_coefficient": [337.7, 0.0, -0.00122, 1.38e-06, -3.01e-09],
        "distortion_center": [159.25, 117.5],
        "stretch_matrix": [[1.0033, 0.0015], [0.0018, 1.0]],
        "inverse_poly": [1.0, 338.2, -0.01],
        "rms_overall": 0.24,
        **changes,
    }


def blender(**changes: Any) -> dict[str, Any]:
    """Settings of five cameras of Blender; the first one looks along the scene's y axis, its up being z."""
    upright = [[1.0, 0.0, 0.0, 0.5], [0.0, 0.0, -1.0, 0.2], [0.0, 1.0, 0.0, 1.6], [0.0, 0.0, 0.0, 1.0]]
    frame = {"resolution_x": 1280, "resolution_y": 800, "resolution_percentage": 50, "sensor_fit": "AUTO"}
    sensor = {"sensor_width": 36.0, "sensor_height": 24.0, "matrix_world": upright, "shift_x": 0.0}
    lens = {"lens": 30.0, "fisheye_lens": 10.5, "fisheye_fov": 2.8}
    numbers = (-1.1735143712967577e-05, -0.06, 1e-5, 2e-6, -3e-7)
    lens |= {f"fisheye_polynomial_k{power}": value for power, value in enumerate(numbers)}
    common = {**frame, **sensor, **lens, **changes}
    kinds = ("FISHEYE_LENS_POLYNOMIAL", "FISHEYE_EQUISOLID", "FISHEYE_EQUIDISTANT", "EQUIRECTANGULAR")
    panoramas = {kind.lower(): {"type": "PANO", "panorama_type": kind, **common} for kind in kinds}
    return {"cameras": {**panoramas, "plain": {"type": "PERSP", **common}}}


KB4 = [0.0035, 0.0007, -0.002, 0.0002]
PLANE = [190.98, 190.97, 254.93, 256.9]
EYE = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


def okvis(**changes: Any) -> dict[str, Any]:
    """OKVIS's configuration of two cameras, the second to the right of the first and looking right."""
    lens = {"image_dimension": [512, 512], "distortion_type": "equidistant", "distortion_coefficients": KB4}
    lens |= {"focal_length": PLANE[:2], "principal_point": PLANE[2:], **changes}
    cameras = [{"T_SC": flat(pose)["data"], **lens} for pose in (EYE, RIGHT_OF_FIRST)]
    return {"cameras": cameras, "camera_params": {"camera_rate": 20}, "imu_params": {"a_max": 176.0}}


def svo(kind: str = "equidistant") -> dict[str, Any]:
    """SVO Pro's rig of the same cameras."""
    distortion = {"type": kind, "parameters": {"cols": 1, "rows": 4, "data": KB4}}
    lens = {"image_height": 512, "image_width": 512, "type": "pinhole", "distortion": distortion}
    lens |= {"intrinsics": {"cols": 1, "rows": 4, "data": PLANE}, "line-delay-nanoseconds": 0}
    cameras = [
        {
            "camera": {"label": f"cam{index}", **lens},
            "T_B_C": {"cols": 4, "rows": 4, "data": flat(pose)["data"]},
        }
        for index, pose in enumerate((EYE, RIGHT_OF_FIRST))
    ]
    return {"label": "rig", "cameras": cameras}


def svo_of_one(**changes: Any) -> dict[str, Any]:
    """The first SVO's camera in PTAM's model."""
    numbers = {"cam_fx": 0.51, "cam_fy": 0.8, "cam_cx": 0.5, "cam_cy": 0.52, "cam_d0": 0.93}
    return {"cam_model": "ATAN", "cam_width": 752, "cam_height": 480, **numbers, **changes}


def mc_calib() -> dict[str, Any]:
    """MC-Calib's cameras: the first a fisheye, the second plain, 11 cm to its right."""
    lenses = ((1, KB4, EYE), (0, [-0.1, 0.02, 1e-3, -2e-3, 0.0], RIGHT_OF_FIRST))
    fx, fy, cx, cy = PLANE
    content: dict[str, Any] = {"nb_camera": 2}
    for index, (kind, distortion, pose) in enumerate(lenses):
        in_mm = [[*row[:3], row[3] * 1000] for row in pose[:3]]
        content[f"camera_{index}"] = {
            "camera_matrix": flat([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
            "distortion_vector": flat([distortion]),
            "distortion_type": kind,
            "camera_group": 0,
            "img_width": 512,
            "img_height": 512,
            "camera_pose_matrix": flat([*in_mm, pose[3]]),
        }
    return content


def opensfm() -> dict[str, Any]:
    """OpenSfM's reconstruction of two shots, the second to the right of the first and looking right."""
    names = ("c_x", "c_y", "k1", "k2", "k3", "k4")
    lens = {
        "projection_type": "fisheye_opencv",
        "width": 640,
        "height": 512,
        "focal_x": 0.3,
        "focal_y": 0.301,
    }
    lens |= dict(zip(names, [0.002, -0.001, *KB4], strict=True))
    shots = {
        "a.001.jpg": {"rotation": [0.0, 0.0, 0.0], "translation": [0.0, 0.0, 0.0], "camera": "lens"},
        "b.001.jpg": {"rotation": [0.0, -np.pi / 2, 0.0], "translation": [0.0, 0.0, -0.11], "camera": "lens"},
    }
    return {"cameras": {"lens": lens}, "shots": shots, "points": {"1": {"coordinates": [0, 0, 1]}}}


def adapter() -> dict[str, Any]:
    """Fisheye-Calib-Adapter's double sphere."""
    lens = dict(zip(("fx", "fy", "cx", "cy"), PLANE, strict=True)) | {"alpha": 0.593, "xi": -0.17}
    return {"image": {"width": 512, "height": 512}, "parameter": lens}


def gyroflow(**changes: Any) -> dict[str, Any]:
    """A lens profile of Gyroflow."""
    fx, fy, cx, cy = PLANE
    lens = {"RMS_error": 0.5, "camera_matrix": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]}
    return {
        "name": "Lens",
        "calib_dimension": {"w": 512, "h": 512},
        "orig_dimension": {"w": 1024, "h": 1024},
        "input_horizontal_stretch": 1.0,
        "fps": 59.94,
        "asymmetrical": True,
        "fisheye_params": {**lens, "distortion_coeffs": KB4, "radial_distortion_limit": 2.1},
        **changes,
    }


def spires() -> dict[str, Any]:
    """Oxford Spires' ``sensor.yaml`` of two cameras; LiDAR to camera, the second looks to the right."""
    lens = {
        "intrinsics": PLANE,
        "extra_params": KB4,
        "image_height": 512,
        "image_width": 512,
        "topic": "/cam",
    }
    poses = ([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], [0.0, 0.0, -0.11, 0.0, -HALF, 0.0, HALF])
    cameras = [
        {"label": name, "T_cam_lidar_t_xyz_q_xyzw": pose, **lens}
        for name, pose in zip(("front", "right"), poses, strict=True)
    ]
    return {"sensor": {"cameras": cameras, "camera_model": "OPENCV_FISHEYE", "camera_fov": 160.0}}


MRCAL = """# generated on 2026-11-25
{
    'lensmodel':  'LENSMODEL_OPENCV5',
    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 461.6, 460.2, 362.7, 246.0, -0.277, 0.067, 0.00088, 0.00012, 0.01 ],
    # extrinsics are rt_fromref
    'extrinsics': [ 0, -1.5707963267948966, 0, 0, 0, -0.11 ],
    'imagersize': [ 752, 480 ],
    'icam_intrinsics': 0,
    'optimization_inputs': b'abc',
}
"""
REALITY_CAPTURE = """<x:xmpmeta xmlns:x="adobe:ns:meta/">
  <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
    <rdf:Description xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:Version="3"
       xcr:DistortionModel="brown3t2" xcr:FocalLength35mm="24.5" xcr:Skew="0" xcr:AspectRatio="1.001"
       xcr:PrincipalPointU="-0.0046" xcr:PrincipalPointV="0.0082" xcr:CalibrationPrior="exact">
      <xcr:Rotation>0 -1 0 0 0 -1 1 0 0</xcr:Rotation>
      <xcr:Position>1.5 -0.25 0.75</xcr:Position>
      <xcr:DistortionCoeficients>-0.124 0.107 -0.0105 0 0.0011 -0.0007</xcr:DistortionCoeficients>
    </rdf:Description>
  </rdf:RDF>
</x:xmpmeta>
"""
