# SPDX-License-Identifier: Apache-2.0
"""Every camera model obeys every law, in single and double precision."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch

from sphericalvision.cameras import (
    BrownConradyCamera,
    Camera,
    DoubleSphereCamera,
    EquirectangularCamera,
    ExtendedUnifiedCamera,
    FisheyeCamera,
    KannalaBrandtCamera,
    OCamCamera,
    PinholeCamera,
    RadialPolynomialCamera,
    UnifiedCamera,
)
from tests.laws import camera_laws as laws
from tests.laws import differentiation_laws

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


def _fisheye(projection: str, degrees: float) -> Callable[[float], Camera]:
    return lambda s: FisheyeCamera(projection, [23.0 * s, 22.0], CENTER, SIZE, math.radians(degrees))


OPENCV_14 = [-0.28, 0.07, 1.1e-3, -7e-4, 0.01, 0.05, -0.02, 3e-3, 1e-3, -5e-4, 8e-4, 2e-4, 0.03, -0.02]
MODELS: dict[str, Callable[[float], Camera]] = {  # from a factor near 1 that makes another camera of the kind
    "equidistant": _fisheye("equidistant", 110),
    "equisolid": _fisheye("equisolid", 120),
    "stereographic": _fisheye("stereographic", 95),
    "orthographic": lambda s: FisheyeCamera("orthographic", [44.0 * s, 43.0], CENTER, SIZE, math.radians(85)),
    "equirectangular": lambda s: EquirectangularCamera((48, 96)),
    "band": lambda s: EquirectangularCamera((40, 160), vertical_field_of_view=math.pi / 2),
    "ocam": lambda s: OCamCamera(
        torch.tensor(_direct_polynomial(), dtype=torch.float64),
        [x * s for x in INVERSE],
        CENTER,
        [1.0003, -2.7e-4, -9.2e-4],
        SIZE,
        math.radians(110),
    ),
    "ocam exact": lambda s: OCamCamera(
        [x * s for x in _direct_polynomial()], None, CENTER, [0.98, 0.01, -0.02], SIZE, math.radians(110)
    ),
    "double sphere": lambda s: DoubleSphereCamera(
        [24.0 * s, 23.8], CENTER, -0.2, 0.58, SIZE, math.radians(110)
    ),
    "double sphere, xi > 0": lambda s: DoubleSphereCamera(
        [40.0 * s, 39.0], CENTER, 0.46, 0.766, SIZE, math.radians(110)
    ),
    "kannala brandt": lambda s: KannalaBrandtCamera(
        [24.0 * s, 23.8], CENTER, [-0.007, 0.045, -0.0435, 0.0084], SIZE, math.radians(100)
    ),
    "brown conrady": lambda s: BrownConradyCamera(
        [60.0 * s, 61.0], CENTER, [-0.12, 0.03, 1e-3, -7e-4, 0.002], SIZE, math.radians(50)
    ),
    "brown conrady, 14": lambda s: BrownConradyCamera(
        [60.0 * s, 61.0], CENTER, OPENCV_14, SIZE, math.radians(42)
    ),
    "unified": lambda s: UnifiedCamera([48.0 * s, 47.0], CENTER, 0.9, None, SIZE, math.radians(110)),
    "unified, xi > 1": lambda s: UnifiedCamera([75.0 * s, 74.0], CENTER, 2.2, None, SIZE),
    "mei": lambda s: UnifiedCamera([75.0 * s, 74.0], CENTER, 2.2, [0.017, 0.9, 4e-4, 4e-4, 0.01], SIZE),
    "extended unified": lambda s: ExtendedUnifiedCamera([24.0 * s, 23.8], CENTER, 0.63, 1.04, SIZE),
    "radial polynomial": lambda s: RadialPolynomialCamera(
        [24.0 * s, -2.3, 3.4, -0.51], CENTER, 1.02, SIZE, math.radians(110)
    ),
    "pinhole": lambda s: PinholeCamera([60.0 * s, 61.0], CENTER, SIZE),
    "pinhole, 80°": lambda s: PinholeCamera([60.0 * s, 61.0], CENTER, SIZE, math.radians(40)),
}
# Differences cannot look across the hole that an inverse polynomial may leave there; θ² has a kink.
BENT_ON_AXIS = ("ocam", "radial polynomial")
OWN_TOLERANCE = {"ocam": 0.01}  # pixels by which the two polynomials of the file disagree


@pytest.fixture(params=MODELS)
def model(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def camera(request: pytest.FixtureRequest, model: str) -> Camera:
    return MODELS[model](1.0).to(request.param)


@pytest.fixture
def tolerance(model: str, camera: Camera) -> float:
    """Pixels."""
    return OWN_TOLERANCE.get(model, 0.0) + laws.pixel_precision(camera)


def test_unproject_undoes_project(camera: Camera, tolerance: float) -> None:
    laws.law_unproject_undoes_project(camera, tolerance)


def test_project_undoes_unproject(camera: Camera, tolerance: float) -> None:
    laws.law_project_undoes_unproject(camera, tolerance)


def test_round_trip_is_exact(model: str, camera: Camera) -> None:
    if model in OWN_TOLERANCE:
        pytest.skip("its file's two polynomials are not inverse to each other")
    laws.law_round_trip_is_exact(camera)


def test_nan_is_invalid(camera: Camera) -> None:
    laws.law_nan_is_invalid(camera)


def test_directions_are_unit(camera: Camera) -> None:
    laws.law_directions_are_unit(camera)


def test_length_does_not_matter(camera: Camera) -> None:
    laws.law_length_does_not_matter(camera, laws.pixel_precision(camera))


def test_outside_is_invalid_and_finite(camera: Camera) -> None:
    laws.law_outside_is_invalid_and_finite(camera)


def test_gradients_are_finite(camera: Camera) -> None:
    laws.law_gradients_are_finite(camera)


def test_gradients_are_right(model: str) -> None:
    laws.law_gradients_are_right(MODELS[model](1.0))


def test_batch_equals_loop(model: str, camera: Camera) -> None:
    laws.law_batch_equals_loop(camera, MODELS[model](1.1).to(camera.dtype))


def test_sampling_reads_the_projection(camera: Camera) -> None:
    laws.law_sampling_reads_the_projection(camera)


# Of most kinds one is traced in the quick tests; distortion of the plane takes the tracer ten seconds.
TRACED = [
    "equidistant",
    "equirectangular",
    "ocam",
    "ocam exact",
    "double sphere",
    "kannala brandt",
    "extended unified",
    "radial polynomial",
    "pinhole",
]
ALL_TRACED = [name if name in TRACED else pytest.param(name, marks=pytest.mark.slow) for name in MODELS]


def test_second_derivatives_are_right(model: str) -> None:
    differentiation_laws.law_second_derivatives_are_right(
        MODELS[model](1.0), on_axis=model not in BENT_ON_AXIS
    )


def test_transforms_equal_the_loop(model: str) -> None:
    differentiation_laws.law_transforms_equal_the_loop(MODELS[model](1.0))


@pytest.mark.parametrize("model", ALL_TRACED)
def test_compiles_without_graph_breaks(model: str) -> None:
    differentiation_laws.law_compiles_without_graph_breaks(MODELS[model](1.0).to(torch.float64), "aot_eager")


@pytest.mark.parametrize("model", ALL_TRACED)
def test_exports(model: str) -> None:
    differentiation_laws.law_exports(MODELS[model](1.0).to(torch.float64))


@pytest.mark.slow
def test_compiled_gradients(model: str) -> None:
    differentiation_laws.law_compiled_gradients(MODELS[model](1.0).to(torch.float64), "aot_eager")


@pytest.mark.slow
def test_compiles_to_machine_code(model: str) -> None:
    differentiation_laws.law_compiles_without_graph_breaks(MODELS[model](1.0).to(torch.float64), "inductor")
