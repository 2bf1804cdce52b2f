# SPDX-License-Identifier: Apache-2.0
"""The lenses of all formats against projections written away from the package: what a file says is what is seen."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from sphericalvision.cameras import read_camera
from tests.cameras.calibration_samples import (
    KALIBR,
    KB4,
    MATRIX,
    OMNIDIR,
    PLANE,
    TEXTS,
    assert_projects,
    basalt,
    directions,
    double_sphere,
    dump,
    extended_unified,
    kalibr,
    kannala_brandt,
    matrix,
    opencv_fisheye,
    opencv_omnidir,
    opencv_plain,
    sample,
    storage,
    thin_prism,
)


class Lens(NamedTuple):
    """A camera of a file, and where it sees rays up to an angle from the axis: at ``oracle(rays, *numbers)``."""

    file: str
    content: Any
    """None: the sample of this name."""
    model: str
    degrees: float
    oracle: Callable[..., Any]
    numbers: tuple[Any, ...]
    name: str | None = None
    offset: float = 0.0
    """Pixels between the conventions of the oracle and the package's."""
    image_size: tuple[int, int] | None = None


def of_kalibr(kind: str) -> Lens:
    *first, fx, fy, cx, cy = KALIBR[kind]["intrinsics"]
    distortion = KALIBR[kind]["distortion_coeffs"] or [0.0] * 4
    plane, whole = (fx, fy, cx, cy), matrix(fx, fy, cx, cy)
    more: dict[str, tuple[str, float, Callable[..., Any], tuple[Any, ...]]] = {
        "pinhole none": ("pinhole", 60, opencv_plain, (whole, distortion)),
        "pinhole radtan": ("brown_conrady", 25, opencv_plain, (whole, distortion)),
        "pinhole equidistant": ("kannala_brandt", 110, kannala_brandt, (*plane, *distortion)),
        "omni none": ("unified", 60, opencv_omnidir, (whole, *first, distortion)),
        "omni radtan": ("unified", 60, opencv_omnidir, (whole, *first, distortion)),
        "eucm none": ("extended_unified", 60, extended_unified, (*plane, *first)),
        "ds none": ("double_sphere", 60, double_sphere, (*plane, *first)),
    }
    return Lens("camchain.yaml", kalibr(kind), *more[kind])


def of_colmap(line: str) -> Lens:
    """COLMAP counts from the corner of the first pixel, OpenCV from its centre."""
    number, model, _, _, *words = line.split()
    numbers = [float(word) for word in words]
    if len(numbers) in (3, 4, 5) and model != "PINHOLE":  # one focal length
        numbers = [numbers[0], *numbers]
    distortion = numbers[4:] + [0.0] * (8 - len(numbers))
    oracle = opencv_fisheye if "FISHEYE" in model else opencv_plain
    kinds = {"FISHEYE": "kannala_brandt", "PINHOLE": "pinhole"}
    ours = next((kind for key, kind in kinds.items() if key in model), "brown_conrady")
    return Lens(
        "cameras.txt", None, ours, 30, oracle, (matrix(*numbers[:4]), distortion), f"cam{number}", -0.5
    )


def of_basalt(kind: str, model: str, oracle: Callable[..., Any], *numbers: Any) -> Lens:
    return Lens("calibration.json", basalt(kind), model, 60 if kind == "pinhole" else 97, oracle, numbers)


def of_opencv(
    model: str, degrees: float, oracle: Callable[..., Any], numbers: tuple[Any, ...], **values: Any
) -> Lens:
    return Lens("camera.yml", storage(**values), model, degrees, oracle, numbers)


def woodscape(rays: np.ndarray) -> np.ndarray:
    """The equations of the data set's calibration_readme.txt, with the sample's numbers."""
    x, y, z = rays.T
    chi = np.hypot(x, y)
    theta = np.arctan2(chi, z)
    rho = 339.7 * theta - 32.0 * theta**2 + 48.3 * theta**3 - 7.2 * theta**4
    scale = rho / np.where(chi > 0, chi, 1)
    return np.stack((x * scale + 3.9 + 1280 / 2 - 0.5, y * scale * 1.01 - 3.1 + 966 / 2 - 0.5), -1)


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


MULTICOL = {key.removeprefix("Camera."): value for key, value in sample("fisheye.yaml").items()}


def ascending(name: str, value: np.ndarray) -> np.ndarray:
    powers = range(sum(f"{name}{power}" in MULTICOL for power in range(30)))
    return np.asarray(sum(MULTICOL[f"{name}{power}"] * value**power for power in powers))


def multicol(rays: np.ndarray) -> np.ndarray:
    """WorldToImg of MultiCol-SLAM."""
    x, y, z = rays.T
    norm = np.hypot(x, y)
    rho = ascending("pol", np.arctan2(-z, norm)) / np.where(norm > 0, norm, 1)
    u = MULTICOL["c"] * x * rho + MULTICOL["d"] * y * rho + MULTICOL["u0"]
    return np.stack((u, MULTICOL["e"] * x * rho + y * rho + MULTICOL["v0"]), -1)


def rational(radius: float) -> dict[str, Any]:
    """Basalt's rational model, which ends at an undistorted radius."""
    content = basalt("pinhole")
    lens = content["value0"]["intrinsics"][0]
    lens["camera_type"] = "pinhole-radtan8"
    lens["intrinsics"] |= {
        **dict(zip(["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"], RADTAN8, strict=True)),
        "rpmax": radius,
    }
    return content


SMALL, LARGE = {"image_width": 320, "image_height": 240}, {"image_width": 640, "image_height": 512}
CENTER, FISHEYE = (254.96, 256.89), matrix(*PLANE)
PLAIN = [-0.28, 0.07, 0.001, -0.002, 0.01]
RATIONAL = [0.1, 0.02, 0.001, -0.002, 0.01, 0.12, 0.03, 0.004]
RADTAN8 = [0.4, -2.5, 6e-4, -3e-4, 1.6, 0.28, -2.3, 1.5]
OMNI = [-0.1, 0.02, 1e-3, -2e-3]
EQUIDISTANT = ("kannala_brandt", 85, opencv_fisheye, (FISHEYE, KB4))
ARIA = [lens["Projection"]["Params"] for lens in sample("device.json")["CameraCalibrations"]]
OPENSFM = sample("reconstruction.json")["cameras"]
LONGER = 24.5 * 640 / 36  # of RealityCapture, whose lengths are in units of the longer side
LENSES = {
    **{f"kalibr {kind}": of_kalibr(kind) for kind in KALIBR},
    "kalibr without a word of distortion": of_kalibr("pinhole none")._replace(
        content={"cam0": {k: v for k, v in KALIBR["pinhole none"].items() if "distortion" not in k}}
    ),
    **{
        f"colmap {line.split()[1]}": of_colmap(line)
        for line in TEXTS["cameras.txt"].splitlines()
        if line[0] != "#"
    },
    "basalt ds": of_basalt("ds", "double_sphere", double_sphere, 158.3, 158.2, *CENTER, -0.17, 0.593),
    "basalt eucm": of_basalt("eucm", "extended_unified", extended_unified, 191.1, 191.2, *CENTER, 0.63, 1.04),
    "basalt ucm": of_basalt("ucm", "unified", extended_unified, 191.1, 191.2, *CENTER, 0.63, 1.0),
    "basalt kb4": of_basalt("kb4", "kannala_brandt", kannala_brandt, 190.98, 190.97, *CENTER, *KB4),
    "basalt pinhole": of_basalt("pinhole", "pinhole", opencv_plain, matrix(300.5, 301.0, *CENTER), [0.0] * 4),
    **{
        f"basalt radtan8, {radius}": Lens(
            "calibration.json", rational(radius), "brown_conrady", 30, opencv_plain,
            (matrix(300.5, 301.0, *CENTER), RADTAN8),
        )
        for radius in (0.0, 0.8)
    },
    "camodocal mei": Lens(
        "image_02.yaml", None, "unified", 85, opencv_omnidir,
        (matrix(1336.3, 1335.8, 716.9, 705.8), 2.2134, [0.0168, 1.6549, 4.2e-4, 4.3e-4]),
    ),
    "camodocal pinhole": Lens(
        "pinhole.yaml", None, "brown_conrady", 25, opencv_plain,
        (matrix(461.6, 460.2, 362.7, 246.0), [-0.277, 0.067, 0.00088, 0.00012]),
    ),
    "camodocal kannala-brandt": Lens("kannala.yaml", None, *EQUIDISTANT),
    "stella_vslam fisheye": Lens("stella.yaml", None, *EQUIDISTANT),
    "stella_vslam perspective": Lens(
        "stella_perspective.yaml", None, "brown_conrady", 25, opencv_plain,
        (FISHEYE, [-0.28, 0.07, 2e-4, 2e-5, 0.01]),
    ),
    **{
        f"opencv plain, {len(k)}": of_opencv(
            "brown_conrady", 28, opencv_plain, (MATRIX, k), **SMALL, camera_matrix=MATRIX, distortion_coefficients=k
        )
        for k in (PLAIN[:4], PLAIN, RATIONAL)
    },
    "opencv plain by its flag": of_opencv(
        "brown_conrady", 28, opencv_plain, (MATRIX, PLAIN[:4]), **SMALL, fisheye_model=0, K=MATRIX, D=PLAIN[:4]
    ),
    "opencv fisheye by its flag": of_opencv(
        *EQUIDISTANT, **LARGE, fisheye_model=1, camera_matrix=FISHEYE, distortion_coefficients=KB4
    ),
    "opencv fisheye by ROS's name": of_opencv(
        *EQUIDISTANT, **LARGE, distortion_model="equidistant", camera_matrix=FISHEYE, distortion_coefficients=KB4
    ),
    "opencv fisheye by names of cv2.fisheye": of_opencv(*EQUIDISTANT, **LARGE, K=FISHEYE, D=KB4),
    "opencv omnidir": of_opencv(
        "unified", 80, opencv_omnidir, (OMNIDIR, 1.2, OMNI), **LARGE, K=OMNIDIR, D=OMNI, xi=[1.2]
    ),
    "kitti": Lens(
        "calib_cam_to_cam.txt", None, "brown_conrady", 25, opencv_plain,
        (matrix(989.5, 987.8, 702.0, 245.6), [-0.36, 0.19, 0.0004, -0.0005, -0.06]), "cam1",
    ),
    "euroc": Lens(
        "sensor.yaml", None, "brown_conrady", 30, opencv_plain,
        (matrix(458.6, 457.3, 367.2, 248.4), sample("sensor.yaml")["distortion_coefficients"]),
    ),
    "orb-slam fisheye": Lens("settings.yaml", None, *EQUIDISTANT, "cam2"),
    "orb-slam pinhole": Lens(
        "settings_pinhole.yaml", None, "brown_conrady", 30, opencv_plain,
        (FISHEYE, [-0.28, 0.07, 2e-4, 2e-5]), "cam2",
    ),
    "aria": Lens("device.json", None, "kannala_brandt", 60, kannala_brandt, tuple(ARIA[1]), "camera-rgb"),
    "aria, fisheye624": Lens(  # whose p0 and p1 are p2 and p1
        "device.json", None, "thin_prism_fisheye", 60, thin_prism,
        ([ARIA[0][0]] * 2, ARIA[0][1:3], ARIA[0][3:9], (ARIA[0][10], ARIA[0][9], *ARIA[0][11:])), "camera-slam-left",
    ),
    "nerfstudio": Lens("transforms.json", None, *EQUIDISTANT),  # whose file is half a pixel off
    **{
        name: Lens(file, content, "kannala_brandt", 50, kannala_brandt, (*plane, *KB4), camera)
        for name, file, content, plane, camera in (
            ("okvis", "okvis.yaml", None, PLANE, "cam0"),
            ("svo", "svo.yaml", None, PLANE, "cam0"),
            ("spires", "spires.yaml", None, PLANE, "front"),
            ("opensfm", "cameras.json", OPENSFM, [192.0, 192.64, 320.78, 254.86], "lens"),
        )
    },
    "adapter": Lens("DS.yml", None, "double_sphere", 50, double_sphere, (*PLANE, -0.17, 0.593)),
    **{
        f"gyroflow, asymmetrical={free}": Lens(
            "lens.json", sample("lens.json", asymmetrical=free), "kannala_brandt", 50, kannala_brandt,
            (*PLANE[:2], *center, *KB4),
        )
        for free, center in ((True, PLANE[2:]), (False, [256.0, 256.0]))
    },
    "woodscape": Lens("FV.json", None, "radial_polynomial", 95, woodscape, ()),
    "multicol": Lens("fisheye.yaml", None, "ocam", 80, multicol, ()),
    "metashape alone": Lens("lens.xml", None, "brown_conrady", 35, metashape, (False, 0.0, 0.5, 0.25)),
    "metashape frame": Lens("chunk.xml", None, "brown_conrady", 35, metashape, (False,), "cam0"),
    "metashape fisheye": Lens("chunk.xml", None, "thin_prism_fisheye", 35, metashape, (True, 0.003), "cam1"),
    "realitycapture": Lens(
        "image001.xmp", None, "brown_conrady", 30, opencv_plain,
        (
            matrix(LONGER, LONGER * 1.001, 320 - 0.0046 * 640 - 0.5, 240 + 0.0082 * 640 - 0.5),
            [-0.124, 0.107, -0.0007, 0.0011, -0.0105],
        ),
        image_size=(480, 640),
    ),
}  # fmt: skip


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_a_lens_is_that_of_its_definition(tmp_path: Path, lens: Lens) -> None:
    path = dump(tmp_path / lens.file, TEXTS[lens.file] if lens.content is None else lens.content)
    camera = read_camera(path, lens.name, dtype=torch.float64, image_size=lens.image_size)
    assert camera.model == lens.model
    rays = directions(lens.degrees)
    assert_projects(camera, lens.oracle(rays, *lens.numbers) + lens.offset, rays)


# Formats that define the ray of a pixel -------------------------------------------------------------------------------

SPOTS = np.stack(np.meshgrid(np.linspace(0.2, 0.8, 9), np.linspace(0.2, 0.8, 7)), -1).reshape(-1, 2)
"""Across and up the frame, from its lower left corner, as Blender measures."""
GRID = np.stack(np.meshgrid(np.linspace(3, 316, 9), np.linspace(2, 236, 8)), -1).reshape(-1, 2)
IDEAL = np.array([[200.0, -100.0], [-150.0, 30.0], [5.0, 250.0], [420.0, 90.0]])


def blender(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Cycles' projections of ``SPOTS``."""
    values = sample("blender.json")["cameras"][kind.lower()]
    lens, view = values["fisheye_lens"], values["fisheye_fov"]
    x, y = ((SPOTS - 0.5) * 2 if "EQUIDISTANT" in kind else (SPOTS - 0.5) * [36.0, 22.5])[
        np.any(SPOTS != 0.5, -1)
    ].T
    r = np.hypot(x, y)
    if kind == "FISHEYE_EQUIDISTANT":
        theta = r * view / 2
    elif kind == "FISHEYE_EQUISOLID":
        theta = 2 * np.arcsin(r / (2 * lens))
    else:
        theta = -sum(values[f"fisheye_polynomial_k{power}"] * r**power for power in range(1, 5))
    assert (theta < view / 2).all()
    pixels = np.stack((SPOTS[:, 0] * 640 - 0.5, (1 - SPOTS[:, 1]) * 400 - 0.5), -1)[np.any(SPOTS != 0.5, -1)]
    return pixels, np.stack((np.sin(theta) * x / r, -np.sin(theta) * y / r, np.cos(theta)), -1)


def py_ocamcalib() -> tuple[np.ndarray, np.ndarray]:
    """Its cam2world: the centre off, the stretch undone, (x, y, f(ρ))."""
    content = sample("calibration_fisheye.json")
    x, y = np.linalg.solve(content["stretch_matrix"], (GRID - content["distortion_center"]).T)
    return GRID, np.stack((x, y, np.polyval(content["taylor_coefficient"][::-1], np.hypot(x, y))), -1)


def image_to_world() -> tuple[np.ndarray, np.ndarray]:
    """ImgToWorld of MultiCol-SLAM."""
    u, v = (GRID - [MULTICOL["u0"], MULTICOL["v0"]]).T
    c, d, e = (MULTICOL[key] for key in "cde")
    x, y = (u - d * v) / (c - d * e), (-e * u + c * v) / (c - d * e)
    return GRID, np.stack((x, y, -ascending("a", np.hypot(x, y))), -1)


def scaramuzza(ac: float = 1.0, ad: float = 0.0, ae: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """u = ac x + ad y + cx and v = ae x + y + cy look along (x, y, -p(r)), as camodocal's source has it."""
    polynomial = list(sample("scaramuzza.yaml")["poly_parameters"].values())
    z = -np.polynomial.polynomial.polyval(np.hypot(*IDEAL.T), polynomial)
    return IDEAL @ np.array([[ac, ad], [ae, 1.0]]).T + (645.1, 486.0), np.column_stack((IDEAL, z))


AFFINE = {"ac": 1.02, "ad": 0.003, "ae": -0.002}
SCARAMUZZA = sample("scaramuzza.yaml")
RAYS: dict[str, tuple[str, Any, str | None, tuple[np.ndarray, np.ndarray]]] = {
    **{
        kind: ("blender.json", None, kind.lower(), blender(kind))
        for kind in ("FISHEYE_EQUIDISTANT", "FISHEYE_EQUISOLID", "FISHEYE_LENS_POLYNOMIAL")
    },
    "py_ocamcalib": ("calibration_fisheye.json", None, None, py_ocamcalib()),
    "multicol": ("fisheye.yaml", None, None, image_to_world()),
    "scaramuzza": ("scaramuzza.yaml", None, None, scaramuzza()),
    "scaramuzza, affine": (
        "scaramuzza.yaml",
        SCARAMUZZA | {"affine_parameters": SCARAMUZZA["affine_parameters"] | AFFINE},
        None,
        scaramuzza(**AFFINE),
    ),
}


@pytest.mark.parametrize("name", RAYS)
def test_a_pixel_looks_along_the_ray_of_its_definition(tmp_path: Path, name: str) -> None:
    file, content, camera_name, (pixels, rays) = RAYS[name]
    path = dump(tmp_path / file, TEXTS[file] if content is None else content)
    size = (240, 320) if name == "py_ocamcalib" else None
    camera = read_camera(path, camera_name, dtype=torch.float64, image_size=size)
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    found, valid = camera.unproject(torch.from_numpy(pixels))
    assert valid.all()
    np.testing.assert_allclose(found.numpy(), rays, rtol=0, atol=1e-9)
    if name != "multicol":  # which has an inverse polynomial of its own
        assert_projects(camera, pixels, rays, 1e-8)
