# SPDX-License-Identifier: Apache-2.0
"""The cameras that every law is tried on: a new model is one more entry of ``CAMERAS``."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from sphericalvision.cameras import (
    AnglePolynomialCamera,
    AtanCamera,
    BrownConradyCamera,
    Camera,
    CameraRig,
    DivisionCamera,
    DoubleSphereCamera,
    EquirectangularCamera,
    ExtendedUnifiedCamera,
    FisheyeCamera,
    KannalaBrandtCamera,
    OCamCamera,
    PinholeCamera,
    RadialPolynomialCamera,
    ThinPrismFisheyeCamera,
    UnifiedCamera,
    ring_rig,
)
from sphericalvision.geometry import transform_from_axis_angle
from tests.values import rand


@dataclass(frozen=True)
class CameraCase:
    """A camera, and the little that laws must know of it.

    Attributes:
        name: in the names of tests.
        make: from a factor near 1 that makes another camera of the kind.
        own_tolerance: pixels by which the two polynomials of a file disagree.
        smooth_on_axis: whether differences can be taken there; not across the hole that an inverse polynomial may
            leave, and θ² has a kink.
        traced: compiled and exported in the quick tests: of most kinds one, and none with distortion of the plane,
            which takes the tracer ten seconds.
    """

    name: str
    make: Callable[[float], Camera]
    own_tolerance: float = 0.0
    smooth_on_axis: bool = True
    traced: bool = False


SIZE = (96, 112)
CENTER = (55.2, 47.1)  # off the middle, and not a whole pixel
# rho = 24 * angle, and the direct polynomial that comes closest to it up to 110° (0.003 px). In float64, so that rho
# is 0 on the axis: else there is a hole of 1e-7 px, across which finite differences cannot look.
INVERSE = [24 * math.pi / 2, 24.0]


def _direct_polynomial() -> list[float]:
    """Least squares fit of f(rho) = -rho / tan(rho / 24)."""
    rho = torch.linspace(1e-3, 24 * math.radians(112), 400, dtype=torch.float64)
    powers = [0, 2, 3, 4, 5, 6, 7, 8]
    scale = rho.max()
    columns = torch.stack([(rho / scale) ** power for power in powers], -1)
    solution = torch.linalg.lstsq(columns, -rho / torch.tan(rho / 24)).solution
    coefficients = [0.0] * 9
    for power, value in zip(powers, solution.tolist(), strict=True):
        coefficients[power] = value / float(scale) ** power
    return coefficients


def _fisheye(projection: str, degrees: float, focal_length: float = 23.0) -> Callable[[float], Camera]:
    return lambda s: FisheyeCamera(
        projection, [focal_length * s, focal_length - 1], CENTER, SIZE, math.radians(degrees)
    )


def _thin_prism(s: float, composition: str, distortion: list[float]) -> Camera:
    return ThinPrismFisheyeCamera(
        [24.0 * s, 23.8],
        CENTER,
        distortion,
        [1.2e-3, -8e-4],
        [2e-3, -3e-4, 1.5e-3, 2e-4],
        SIZE,
        math.radians(95),
        composition,
    )


OPENCV = [-0.28, 0.07, 1.1e-3, -7e-4, 0.01, 0.05, -0.02, 3e-3, 1e-3, -5e-4, 8e-4, 2e-4, 0.03, -0.02]
"""k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 τx τy."""
CAMERAS = [
    CameraCase("equidistant", _fisheye("equidistant", 110), traced=True),
    CameraCase("equisolid", _fisheye("equisolid", 120)),
    CameraCase("stereographic", _fisheye("stereographic", 95)),
    CameraCase("orthographic", _fisheye("orthographic", 85, 44.0)),
    CameraCase("equirectangular", lambda s: EquirectangularCamera((48, 96)), traced=True),
    CameraCase(
        "corner", lambda s: EquirectangularCamera((40, 90), latitudes=(-1.3, 0.9), longitudes=(-1.5, 2.6))
    ),
    CameraCase(
        "from behind",
        lambda s: EquirectangularCamera(
            (40, 90), latitudes=(-0.9, math.pi / 2), longitudes=(1, 1 + 2 * math.pi)
        ),
    ),
    CameraCase("band", lambda s: EquirectangularCamera((40, 160), vertical_field_of_view=math.pi / 2)),
    CameraCase(
        "ocam",
        lambda s: OCamCamera(
            torch.tensor(_direct_polynomial(), dtype=torch.float64),
            [x * s for x in INVERSE],
            CENTER,
            [1.0003, -2.7e-4, -9.2e-4],
            SIZE,
            math.radians(110),
        ),
        own_tolerance=0.01,
        smooth_on_axis=False,
    ),
    CameraCase(
        "ocam exact",
        lambda s: OCamCamera(
            [x * s for x in _direct_polynomial()], None, CENTER, [0.98, 0.01, -0.02], SIZE, math.radians(110)
        ),
        traced=True,
    ),
    CameraCase(
        "double sphere",
        lambda s: DoubleSphereCamera([24.0 * s, 23.8], CENTER, -0.2, 0.58, SIZE, math.radians(110)),
        traced=True,
    ),
    CameraCase(
        "double sphere, xi > 0",
        lambda s: DoubleSphereCamera([40.0 * s, 39.0], CENTER, 0.46, 0.766, SIZE, math.radians(110)),
    ),
    CameraCase(
        "kannala brandt",
        lambda s: KannalaBrandtCamera(
            [24.0 * s, 23.8], CENTER, [-0.007, 0.045, -0.0435, 0.0084], SIZE, math.radians(100)
        ),
        traced=True,
    ),
    CameraCase(
        "kannala brandt, 6",
        lambda s: KannalaBrandtCamera(
            [24.0 * s, 23.8], CENTER, [0.03, -0.02, 0.004, 1e-3, -4e-4, 3e-5], SIZE, math.radians(100)
        ),
    ),
    CameraCase(
        "angle polynomial",
        lambda s: AnglePolynomialCamera(
            [24.0 * s, 23.8], CENTER, [-0.004, 0.03, -0.002, 0.001], SIZE, math.radians(105)
        ),
        smooth_on_axis=False,
    ),
    CameraCase(
        "kannala brandt, skew",
        lambda s: KannalaBrandtCamera(
            [24.0 * s, 23.8], CENTER, [-0.007, 0.045, -0.0435, 0.0084], SIZE, math.radians(100), 0.6 * s
        ),
    ),
    CameraCase(
        "mei, skew",
        lambda s: UnifiedCamera(
            [75.0 * s, 74.0], CENTER, 2.2, [0.017, 0.9, 4e-4, 4e-4, 0.01], SIZE, skew=-0.4 * s
        ),
    ),
    CameraCase("atan", lambda s: AtanCamera([26.0 * s, 25.8], CENTER, 0.93, SIZE, math.radians(105))),
    CameraCase("division", lambda s: DivisionCamera([30.0 * s, 29.7], CENTER, [-0.22], SIZE)),
    CameraCase(
        "division, 3",
        lambda s: DivisionCamera([30.0 * s, 29.7], CENTER, [-0.24, 0.02, -0.003], SIZE, math.radians(100)),
    ),
    CameraCase(
        "thin prism fisheye", lambda s: _thin_prism(s, "sequential", [0.03, -0.02, 0.004, 1e-3, -4e-4, 3e-5])
    ),
    CameraCase(
        "thin prism fisheye, additive", lambda s: _thin_prism(s, "additive", [-0.007, 0.045, -0.0435, 0.0084])
    ),
    CameraCase(
        "brown conrady",
        lambda s: BrownConradyCamera(
            [60.0 * s, 61.0], CENTER, [-0.12, 0.03, 1e-3, -7e-4, 0.002], SIZE, math.radians(50)
        ),
    ),
    CameraCase(
        "brown conrady, 14, skew",
        lambda s: BrownConradyCamera([60.0 * s, 61.0], CENTER, OPENCV, SIZE, math.radians(42), 0.6 * s),
    ),
    CameraCase(
        "unified", lambda s: UnifiedCamera([48.0 * s, 47.0], CENTER, 0.9, None, SIZE, math.radians(110))
    ),
    CameraCase("unified, xi > 1", lambda s: UnifiedCamera([75.0 * s, 74.0], CENTER, 2.2, None, SIZE)),
    CameraCase(
        "mei", lambda s: UnifiedCamera([75.0 * s, 74.0], CENTER, 2.2, [0.017, 0.9, 4e-4, 4e-4, 0.01], SIZE)
    ),
    CameraCase(
        "extended unified",
        lambda s: ExtendedUnifiedCamera([24.0 * s, 23.8], CENTER, 0.63, 1.04, SIZE),
        traced=True,
    ),
    CameraCase(
        "radial polynomial",
        lambda s: RadialPolynomialCamera([24.0 * s, -2.3, 3.4, -0.51], CENTER, 1.02, SIZE, math.radians(110)),
        smooth_on_axis=False,
        traced=True,
    ),
    CameraCase("pinhole", lambda s: PinholeCamera([60.0 * s, 61.0], CENTER, SIZE), traced=True),
    CameraCase(
        "pinhole, 80 degrees, skew",
        lambda s: PinholeCamera([60.0 * s, 61.0], CENTER, SIZE, math.radians(40), -0.4 * s),
    ),
]
MODELS: dict[str, Callable[[float], Camera]] = {case.name: case.make for case in CAMERAS}


def uneven_rig(size: Sequence[int] = (36, 50)) -> CameraRig:
    """Three lenses, one narrower and masked, turned and moved, around a centre off the origin."""
    ring = ring_rig(3, 0.25, size, 3.7).to(dtype=torch.float64)
    narrow = FisheyeCamera.from_field_of_view(size, 2.9).to(torch.float64)
    wobble = transform_from_axis_angle(0.4 * rand(3, 3, seed=1) - 0.2, 0.1 * rand(3, 3, seed=2))
    poses = ring.world_from_camera @ wobble
    poses[:, :3, 3] += torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
    mask = torch.ones(*size, dtype=torch.bool)
    mask[22:, :17] = False
    return CameraRig({"a": ring.cameras["cam1"], "b": narrow, "c": ring.cameras["cam3"]}, poses, {"b": mask})
