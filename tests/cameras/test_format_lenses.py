# SPDX-License-Identifier: Apache-2.0
"""The lenses of all formats against projections written away from the package: what a file says is what is seen."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch

from sphericalvision.cameras import read_camera
from tests.cameras.calibration_samples import (
    COLMAP,
    FISHEYE,
    KALIBR,
    KB4,
    KITTI,
    MATRIX,
    OMNIDIR,
    PLANE,
    adapter,
    aria,
    asl,
    assert_projects,
    basalt,
    camodocal_kannala_brandt,
    camodocal_pinhole,
    directions,
    double_sphere,
    dump,
    extended_unified,
    gyroflow,
    kalibr,
    kannala_brandt,
    mei,
    okvis,
    opencv_fisheye,
    opencv_omnidir,
    opencv_plain,
    opencv_yaml,
    opensfm,
    orbslam,
    spires,
    stella_vslam,
    svo,
    transforms,
)


class Lens(NamedTuple):
    """A camera of a file, and where it sees rays up to an angle from the axis: at ``oracle(rays, *numbers)``."""

    file: str
    content: Any
    model: str
    degrees: float
    oracle: Callable[..., Any]
    numbers: tuple[Any, ...]
    name: str | None = None
    offset: float = 0.0
    """Pixels between the conventions of the oracle and the package's."""


def matrix(fx: float, fy: float, cx: float, cy: float) -> list[list[float]]:
    return [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]


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
    seen = (matrix(*numbers[:4]), distortion)
    return Lens("cameras.txt", COLMAP, ours, 30, oracle, seen, f"cam{number}", -0.5)


def of_basalt(kind: str, model: str, oracle: Callable[..., Any], *numbers: Any) -> Lens:
    return Lens("calibration.json", basalt(kind), model, 60 if kind == "pinhole" else 97, oracle, numbers)


def of_opencv(
    model: str, degrees: float, oracle: Callable[..., Any], numbers: tuple[Any, ...], **values: Any
) -> Lens:
    return Lens("camera.yml", opencv_yaml(**values), model, degrees, oracle, numbers)


SMALL, LARGE = {"image_width": 320, "image_height": 240}, {"image_width": 640, "image_height": 512}
CENTER = (254.96, 256.89)
PLAIN = [-0.28, 0.07, 0.001, -0.002, 0.01]
RATIONAL = [0.1, 0.02, 0.001, -0.002, 0.01, 0.12, 0.03, 0.004]
OMNI = [-0.1, 0.02, 1e-3, -2e-3]
EQUIDISTANT = ("kannala_brandt", 85, opencv_fisheye, (FISHEYE, KB4))
LENSES = {
    **{f"kalibr {kind}": of_kalibr(kind) for kind in KALIBR},
    **{f"colmap {line.split()[1]}": of_colmap(line) for line in COLMAP.splitlines() if line[0] != "#"},
    "basalt ds": of_basalt("ds", "double_sphere", double_sphere, 158.3, 158.2, *CENTER, -0.17, 0.593),
    "basalt eucm": of_basalt("eucm", "extended_unified", extended_unified, 191.1, 191.2, *CENTER, 0.63, 1.04),
    "basalt ucm": of_basalt("ucm", "unified", extended_unified, 191.1, 191.2, *CENTER, 0.63, 1.0),
    "basalt kb4": of_basalt("kb4", "kannala_brandt", kannala_brandt, 190.98, 190.97, *CENTER, *KB4),
    "basalt pinhole": of_basalt("pinhole", "pinhole", opencv_plain, matrix(300.5, 301.0, *CENTER), [0.0] * 4),
    "camodocal mei": Lens(
        "image_02.yaml", mei(), "unified", 85, opencv_omnidir,
        (matrix(1336.3, 1335.8, 716.9, 705.8), 2.2134, [0.0168, 1.6549, 4.2e-4, 4.3e-4]),
    ),
    "camodocal pinhole": Lens(
        "cam0.yaml", camodocal_pinhole(), "brown_conrady", 25, opencv_plain,
        (matrix(461.6, 460.2, 362.7, 246.0), [-0.277, 0.067, 0.00088, 0.00012]),
    ),
    "camodocal kannala-brandt": Lens("cam0.yaml", camodocal_kannala_brandt(), *EQUIDISTANT),
    "stella_vslam fisheye": Lens("config.yaml", stella_vslam(), *EQUIDISTANT),
    "stella_vslam perspective": Lens(
        "config.yaml", stella_vslam(nested=True), "brown_conrady", 25, opencv_plain,
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
        "calib_cam_to_cam.txt", KITTI, "brown_conrady", 25, opencv_plain,
        (matrix(989.5, 987.8, 702.0, 245.6), [-0.36, 0.19, 0.0004, -0.0005, -0.06]), "cam1",
    ),
    "euroc": Lens(
        "camera.yaml", asl(), "brown_conrady", 30, opencv_plain,
        (matrix(458.6, 457.3, 367.2, 248.4), asl()["distortion_coefficients"]),
    ),
    "orb-slam fisheye": Lens("stereo.yaml", orbslam(), *EQUIDISTANT, "cam2"),
    "orb-slam pinhole": Lens(
        "stereo.yaml", orbslam("PinHole"), "brown_conrady", 30, opencv_plain,
        (FISHEYE, [-0.28, 0.07, 2e-4, 2e-5]), "cam2",
    ),
    "aria": Lens(
        "device.json", aria(), "kannala_brandt", 60, kannala_brandt,
        tuple(aria()["CameraCalibrations"][1]["Projection"]["Params"]), "camera-rgb",
    ),
    "nerfstudio": Lens("transforms.json", transforms(), *EQUIDISTANT),  # whose file is half a pixel off
    **{
        name: Lens(file, content, "kannala_brandt", 50, kannala_brandt, (*plane, *KB4), camera)
        for name, file, content, plane, camera in (
            ("okvis", "okvis.yaml", okvis(), PLANE, "cam0"),
            ("svo", "svo.yaml", svo(), PLANE, "cam0"),
            ("spires", "spires.yaml", spires(), PLANE, "front"),
            ("opensfm", "cameras.json", opensfm()["cameras"], [192.0, 192.64, 320.78, 254.86], "lens"),
        )
    },
    "adapter": Lens("DS.yml", adapter(), "double_sphere", 50, double_sphere, (*PLANE, -0.17, 0.593)),
    **{
        f"gyroflow, asymmetrical={free}": Lens(
            "lens.json", gyroflow(asymmetrical=free), "kannala_brandt", 50, kannala_brandt, (*PLANE[:2], *center, *KB4)
        )
        for free, center in ((True, PLANE[2:]), (False, [256.0, 256.0]))
    },
}  # fmt: skip


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_a_lens_is_that_of_its_definition(tmp_path: Path, lens: Lens) -> None:
    path = tmp_path / lens.file
    if isinstance(lens.content, str):
        path.write_text(lens.content)
    else:
        dump(path, lens.content)
    camera = read_camera(path, lens.name, dtype=torch.float64)
    assert camera.model == lens.model
    rays = directions(lens.degrees)
    assert_projects(camera, lens.oracle(rays, *lens.numbers) + lens.offset, rays)
