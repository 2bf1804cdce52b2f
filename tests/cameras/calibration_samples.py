# SPDX-License-Identifier: Apache-2.0
"""Small calibrations of every format, as files in ``files/``, and their projections, written down a second time."""

from __future__ import annotations

import copy
import json
import math
import os
from collections.abc import Callable
from functools import partial
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
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


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

FILES = Path(__file__).parent / "files"


def text(name: str) -> str:
    """The text of a sample."""
    return (FILES / name).read_text()


def sample(file: str, /, **changes: Any) -> Any:
    """The parsed keys of a sample, with other values of some."""
    content = json.loads(text(file)) if file.endswith("json") else yaml.load(text(file), LOADER)
    return content | changes


COLMAP, KITTI, MRCAL, REALITY_CAPTURE = map(
    text, ("cameras.txt", "calib_cam_to_cam.txt", "front.cameramodel", "image001.xmp")
)
mei = partial(sample, "image_02.yaml")
camodocal_pinhole = partial(sample, "pinhole.yaml")
camodocal_kannala_brandt = partial(sample, "kannala.yaml")
multicol = partial(sample, "fisheye.yaml")
multicol_system = partial(sample, "system.yaml")
asl = partial(sample, "sensor.yaml")
transforms = partial(sample, "transforms.json")
aria = partial(sample, "device.json")
py_ocamcalib = partial(sample, "calibration_fisheye.json")
svo = partial(sample, "svo.yaml")
svo_of_one = partial(sample, "atan.yaml")
mc_calib = partial(sample, "mc_calib.yaml")
opensfm = partial(sample, "reconstruction.json")
adapter = partial(sample, "DS.yml")
gyroflow = partial(sample, "lens.json")
spires = partial(sample, "spires.yaml")
opencv_stereo = partial(sample, "stereo.yaml")

_KALIBR = (
    "pinhole none", "pinhole radtan", "pinhole equidistant", "omni none", "omni radtan", "eucm none", "ds none"
)  # fmt: skip
KALIBR: dict[str, dict[str, Any]] = {
    kind: {key: value for key, value in lens.items() if key not in ("rostopic", "T_cn_cnm1")}
    for kind, lens in zip(_KALIBR, sample("camchain.yaml").values(), strict=True)
}


def kalibr(*kinds: str, **changes: Any) -> dict[str, Any]:
    """A camchain of these cameras, each 10 cm to the right of the one before and a quarter turn further right."""
    step = sample("camchain.yaml")["cam1"]["T_cn_cnm1"]
    content: dict[str, Any] = {}
    for index, kind in enumerate(kinds):
        content[f"cam{index}"] = (
            KALIBR[kind] | {"rostopic": f"/cam{index}"} | ({"T_cn_cnm1": step} if index else {})
        )
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


SCARAMUZZA = tuple(sample("scaramuzza.yaml")["poly_parameters"].values())
"""A panoramic annular lens: z = -(p0 + p1 r + ...)."""


def camodocal_scaramuzza(**affine: float) -> dict[str, Any]:
    content = sample("scaramuzza.yaml")
    content["affine_parameters"] |= affine
    return dict(content)


def stella_vslam(nested: bool = False) -> dict[str, Any]:
    """stella_vslam's settings of one camera, a fisheye, or with nested keys a plain one."""
    if nested:
        return dict(sample("stella_perspective.yaml"))
    camera = (content := sample("stella.yaml")).pop("Camera")
    return {f"Camera.{key}": value for key, value in camera.items()} | content


def woodscape(name: str = "FV", **changes: Any) -> dict[str, Any]:
    """A front camera: it looks along the vehicle's x, its y down being the vehicle's -z."""
    content = sample("FV.json", name=name)
    content["intrinsic"] |= changes
    return dict(content)


MULTICOL_C, MULTICOL_D, MULTICOL_E = (multicol()[f"Camera.{key}"] for key in "cde")
"""An affine part far enough from 1 to be noticed."""


def basalt(*kinds: str) -> dict[str, Any]:
    """A rig of these camera types: front, then one that looks to the right."""
    rig = sample("calibration.json")["value0"]
    lenses = {lens["camera_type"]: lens for lens in rig["intrinsics"]}
    return {
        "value0": {
            "T_imu_cam": [rig["T_imu_cam"][index % 2] for index in range(len(kinds))],
            "intrinsics": [copy.deepcopy(lenses[kind]) for kind in kinds],
            "resolution": [[512, 512]] * len(kinds),
        }
    }


def flat(rows: Any) -> dict[str, Any]:
    """A FileStorage matrix of rows of numbers, as it is parsed."""
    data = [float(value) for row in rows for value in row]
    return {"rows": len(rows), "cols": len(rows[0]), "dt": "f", "data": data}


RIGHT_OF_FIRST = [[0.0, 0.0, 1.0, 0.11], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
"""The pose of a second camera 11 cm to the right of the first that looks to the right, in the first's frame."""


def orbslam(kind: str = "KannalaBrandt8", **changes: Any) -> dict[str, Any]:
    """ORB-SLAM3's settings of two cameras."""
    return dict(sample("settings_pinhole.yaml" if kind == "PinHole" else "settings.yaml", **changes))


def blender(**changes: Any) -> dict[str, Any]:
    """Settings of five cameras of Blender; the first one looks along the scene's y axis, its up being z."""
    content = sample("blender.json")
    for camera in content["cameras"].values():
        camera |= changes
    return dict(content)


KB4 = [0.0035, 0.0007, -0.002, 0.0002]
PLANE = [190.98, 190.97, 254.93, 256.9]
EYE = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


def okvis(**changes: Any) -> dict[str, Any]:
    """OKVIS's configuration of two cameras, the second to the right of the first and looking right."""
    content = sample("okvis.yaml")
    for camera in content["cameras"]:
        camera |= changes
    return dict(content)
