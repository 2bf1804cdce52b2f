# SPDX-License-Identifier: Apache-2.0
"""Small calibrations of every format, the files in ``files/``, and projections written down a second time."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterable
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import yaml
from torch import Tensor

from sphericalvision.cameras import Camera, read_cameras, read_rig
from sphericalvision.core import ArgumentError, FileFormatError

DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # ten times as fast, where libyaml is there
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
FILES = Path(__file__).parent / "files"
ELSEWHERE = ("system.yaml",)
"""Files whose cameras are in others beside them."""
TEXTS = {path.name: path.read_text() for path in sorted(FILES.iterdir()) if path.name not in ELSEWHERE}
KEYED = tuple(
    name for name in TEXTS if name.endswith((".yaml", ".json", ".yml")) and not name.startswith("plain")
)
"""Those of keys with values, as YAML or JSON."""


def unit_of(path: Path) -> str | None:
    """The unit that has to be given for a sample, which does not tell it."""
    return "mm" if path.stem in ("stereo", "mc_calib") else None


def sample(file: str, /, **changes: Any) -> dict[str, Any]:
    """The parsed keys of a sample, with other values of some."""
    text = (FILES / file).read_text()
    content = json.loads(text) if file.endswith("json") else yaml.load(text, LOADER)
    return dict(content | changes)


def dumped(content: Any, name: str) -> str:
    """Keys with values as JSON or YAML, by the name of the file."""
    return json.dumps(content) if name.endswith("json") else yaml.dump(content, None, DUMPER, sort_keys=False)


def dump(path: Path, content: Any) -> Path:
    """Write text, or keys with values as JSON or YAML."""
    path.write_text(content if isinstance(content, str) else dumped(content, path.name))
    return path


def at(content: Any, way: Iterable[str | int]) -> Any:
    """What stands at the end of a way of keys and indices in parsed keys."""
    return reduce(getitem, way, content)


def put(content: Any, way: str, value: Any) -> None:
    """Put a value into parsed keys, at the end of a way such as ``cam0/intrinsics/0``."""
    *before, last = (int(key) if key.isdigit() else key for key in way.split("/"))
    at(content, before)[last] = value


def with_size(read: Callable[..., Any], path: Path, **known: Any) -> Any:
    """What ``read`` reads, with a size of the images only where the file does not tell one."""
    try:
        return read(path, **known)
    except ArgumentError as error:
        if "does not tell" not in str(error) or not str(error).startswith("image_size"):
            raise
        return read(path, image_size=(240, 320), **known)


def read_sample(path: Path) -> Any:
    """The rig of a sample or, if it has no poses, its cameras."""
    try:
        return with_size(read_rig, path, max_angle=1.0, translation_unit=unit_of(path))
    except FileFormatError as error:
        if "without poses" not in str(error):
            raise
        return with_size(read_cameras, path, max_angle=1.0)


def read_everything(path: Path) -> None:
    """A sample as cameras, and as a rig if it is one."""
    with_size(read_cameras, path, max_angle=1.0)
    read_sample(path)


def double(*values: Any) -> list[Tensor]:
    """Each as a tensor in float64."""
    return [torch.tensor(value, dtype=torch.float64) for value in values]


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


def opencv_fisheye(rays: np.ndarray, matrix: Any, distortion: Any, alpha: float = 0.0) -> np.ndarray:
    zero = np.zeros(3)
    points = cv2.fisheye.projectPoints(
        rays[:, None], zero, zero, np.array(matrix, float), np.array(distortion, float), alpha=alpha
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
    return thin_prism(rays, (fx, fy), (cx, cy), k, (0.0,) * 6)


def thin_prism(
    rays: np.ndarray, focal: Any, center: Any, k: Any, terms: Any, composition: str = "sequential"
) -> np.ndarray:
    """θ (1 + k1 θ² + ...) along the azimuth, and (p1, p2, s1, s2, s3, s4) of the distorted or the plain point."""
    x, y, z = rays.T
    radius = np.hypot(x, y)
    scale = np.arctan2(radius, z) / np.where(radius > 0, radius, 1)
    px, py = x * scale, y * scale
    growth = 1 + sum(c * (px * px + py * py) ** i for i, c in enumerate(k, start=1))
    qx, qy = px * growth, py * growth
    (x, y), (p1, p2, s1, s2, s3, s4) = (qx, qy) if composition == "sequential" else (px, py), terms
    r2 = x * x + y * y
    tx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s1 * r2 + s2 * r2 * r2
    ty = 2 * p2 * x * y + p1 * (r2 + 2 * y * y) + s3 * r2 + s4 * r2 * r2
    return np.stack((focal[0] * (qx + tx) + center[0], focal[1] * (qy + ty) + center[1]), -1)


def matrix(fx: float, fy: float, cx: float, cy: float) -> list[list[float]]:
    return [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]


# Samples that are put together ----------------------------------------------------------------------------------------

KINECT = [7.27, 12.43, 2.5e-4, -1.1e-4, 3.94, 7.56, 14.2, 7.7]
"""Distortion of a rational lens: large terms that all but cancel."""
PLANE, KB4 = [190.98, 190.97, 254.93, 256.9], [0.0035, 0.0007, -0.002, 0.0002]
MATRIX = [[300.5, 0.0, 159.25], [0.0, 301.0, 120.75], [0.0, 0.0, 1.0]]
OMNIDIR = [[400.0, 0.0, 320.5], [0.0, 401.0, 240.25], [0.0, 0.0, 1.0]]
QUARTER_TURN = [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
"""Takes what is right of the first camera to the front of the second."""
RIGHT_OF_FIRST = [[0.0, 0.0, 1.0, 0.11], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
"""The pose of a second camera 11 cm to the right of the first that looks to the right, in the first's frame."""

_KALIBR = (
    "pinhole radtan", "pinhole none", "pinhole equidistant", "omni none", "omni radtan", "eucm none", "ds none"
)  # fmt: skip
KALIBR: dict[str, dict[str, Any]] = {
    kind: {key: value for key, value in lens.items() if key not in ("rostopic", "T_cn_cnm1")}
    for kind, lens in zip(_KALIBR, sample("camchain.yaml").values(), strict=True)
}


def kalibr(*kinds: str) -> dict[str, Any]:
    """A camchain of these cameras, each 10 cm to the right of the one before and a quarter turn further right."""
    step = {"T_cn_cnm1": sample("camchain.yaml")["cam1"]["T_cn_cnm1"]}
    return {f"cam{index}": KALIBR[kind] | (step if index else {}) for index, kind in enumerate(kinds)}


def basalt(*kinds: str) -> dict[str, Any]:
    """A rig of these camera types: front, then one that looks to the right."""
    rig = sample("calibration.json")["value0"]
    lenses = {lens["camera_type"]: lens for lens in rig["intrinsics"]}
    return {
        "value0": {
            "T_imu_cam": rig["T_imu_cam"][: len(kinds)],
            "intrinsics": [copy.deepcopy(lenses[kind]) for kind in kinds],
            "resolution": rig["resolution"][: len(kinds)],
        }
    }


def flat(rows: Any) -> dict[str, Any]:
    """A FileStorage matrix of rows of numbers, or of one column, as it is parsed."""
    rows = [row if np.ndim(row) else [row] for row in rows]
    data = [float(value) for row in rows for value in row]
    return {"rows": len(rows), "cols": len(rows[0]), "dt": "d", "data": data}


def storage(**values: Any) -> dict[str, Any]:
    """A parsed FileStorage of OpenCV, in which lists are matrices."""
    return {key: flat(value) if isinstance(value, list) else value for key, value in values.items()}
