# SPDX-License-Identifier: Apache-2.0
"""Camera models against OpenCV, COLMAP and the formulas of their papers, and the ends of their views by scanning these.

The laws know that models invert themselves; that they are what they are called is known here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

from sphericalvision.cameras import (
    AnglePolynomialCamera,
    AtanCamera,
    BrownConradyCamera,
    Camera,
    DivisionCamera,
    DoubleSphereCamera,
    ExtendedUnifiedCamera,
    FisheyeCamera,
    KannalaBrandtCamera,
    OCamCamera,
    PinholeCamera,
    RadialPolynomialCamera,
    ThinPrismFisheyeCamera,
    UnifiedCamera,
    convert,
)
from tests.cameras.calibration_samples import (
    KINECT,
    assert_projects,
    directions,
    double,
    extended_unified,
    kannala_brandt,
    matrix,
    opencv_fisheye,
    opencv_omnidir,
    opencv_plain,
    thin_prism,
)
from tests.laws.camera_laws import circle
from tests.laws.cameras import OPENCV

FOCAL, CENTER, SIZE = [100.0, 110.0], [499.5, 299.5], (600, 1000)
PLANE = (*FOCAL, *CENTER)
MATRIX = matrix(*PLANE)
KB4 = [0.0034823894, 0.0007150348, -0.0020532361, 0.0002029367]
K = [0.01, 0.02, -0.003, 0.004, -0.0005, 0.0001]
TERMS = [0.0031, -0.0042, 0.0051, -0.0006, 0.0072, 0.0008]
MEI = [-0.1, 0.02, 1e-3, -7e-4]
KITTI = (2.2134047507854890, [1.6798235660113681e-02, 1.6548773243373522, 0.0, 0.0, 0.0])
"""KITTI-360, image_02: a lens of 185°, without its tangential distortion."""
TUM = (0.6291060881178562, 1.0418067381860868)
"""TUM-VI, the left lens, as Basalt calibrated it."""
WOODSCAPE = [339.7, -32.0, 48.3, -7.2]
DIRECT, INVERSE = [-392.2, 0.0, 1.2707e-3, -1.7456e-6, 2.2576e-9], [600.0, 390.0, -15.0, -40.0]
AFFINE = [0.999876, -2.91382e-2, 1.66556e-2]


def lens(model: type[Camera], *intrinsics: Any, size: tuple[int, int] = SIZE, **options: Any) -> Any:
    """A model's camera in double precision, on an image that is large enough for most."""
    return model(*double(FOCAL, CENTER, *(x for x in intrinsics if x is not None)), size, **options)


def unified(xi: float, distortion: list[float] | None = None, focal: Any = FOCAL) -> UnifiedCamera:
    tail = None if distortion is None else double(distortion)[0]
    return UnifiedCamera(*double(focal, CENTER, xi), tail, (4001, 4001))


def ocam(
    direct: list[float], inverse: list[float] | None = None, affine: Any = AFFINE, angle: float = 1.9
) -> OCamCamera:
    return OCamCamera(double(direct)[0], inverse, CENTER, affine, (1532, 1600), angle)


def radial(rays: np.ndarray, radius: Callable[[np.ndarray], Any], scale: Any = FOCAL) -> np.ndarray:
    """Pixels of an image radius that is a function of the angle, (row', col') without an affine map."""
    x, y, z = rays.T
    flat = np.hypot(x, y)
    ratio = radius(np.arctan2(flat, z)) / np.where(flat > 0, flat, 1)
    return np.stack((scale[0] * x * ratio + CENTER[0], scale[1] * y * ratio + CENTER[1]), -1)


def powers(coefficients: list[float], first: int = 0) -> Callable[[Any], Any]:
    return lambda x: sum(c * x**power for power, c in enumerate(coefficients, start=first))


def two_spheres(rays: np.ndarray, xi: float, alpha: float) -> np.ndarray:
    """Onto two unit spheres, the second shifted by xi, then by a pinhole shifted by alpha / (1 − alpha)."""
    shifted = rays + np.array([0.0, 0.0, xi])
    second = shifted / np.linalg.norm(shifted, axis=-1, keepdims=True)
    plane = second[:, :2] / (second[:, 2:] + alpha / (1 - alpha)) / (1 - alpha)
    return plane * FOCAL + CENTER


def inverse_of_files(rays: np.ndarray) -> np.ndarray:
    """rho is a polynomial of atan2(−z, hypot(x, y)); affine as row = c·row' + d·col', col = e·row' + col'."""
    ideal = radial(rays, lambda angle: powers(INVERSE)(angle - math.pi / 2), (1.0, 1.0)) - CENTER
    c, d, e = AFFINE
    return np.stack((e * ideal[:, 1] + ideal[:, 0], c * ideal[:, 1] + d * ideal[:, 0]), -1) + CENTER


def mei_radius(angle: np.ndarray) -> Any:
    xi, (k1, k2, *_) = KITTI
    r = np.sin(angle) / (np.cos(angle) + xi)
    return r * (1 + k1 * r**2 + k2 * r**4)


RADII: dict[str, Callable[[Any], Any]] = {
    "equidistant": lambda t: t,
    "equisolid": lambda t: 2 * np.sin(t / 2),
    "stereographic": lambda t: 2 * np.tan(t / 2),
    "orthographic": np.sin,
}
ODD = [240.0, 0, 240 * K[0], 0, 240 * K[1], 0, 240 * K[2]]
PROJECTS: dict[str, tuple[Camera, float, Callable[[np.ndarray], np.ndarray]]] = {  # camera, degrees, pixels of rays
    "pinhole": (lens(PinholeCamera), 60, partial(opencv_plain, matrix=MATRIX, distortion=[0.0] * 4)),
    **{
        f"brown conrady, {len(k)}, {k[0]}": (
            lens(BrownConradyCamera, k), 30, partial(opencv_plain, matrix=MATRIX, distortion=k)
        )
        for k in (*(OPENCV[:n] for n in (4, 5, 8, 12, 14)), KINECT, [0.0] * 5)
    },
    "kannala brandt as OpenCV's": (
        lens(KannalaBrandtCamera, KB4), 79, partial(opencv_fisheye, matrix=MATRIX, distortion=KB4)
    ),
    "kannala brandt past 90°": (lens(KannalaBrandtCamera, K), 100, lambda rays: kannala_brandt(rays, *PLANE, *K)),
    **{
        f"thin prism, {how}": (
            lens(ThinPrismFisheyeCamera, K, TERMS[:2], TERMS[2:], composition=how), 100,
            partial(thin_prism, focal=FOCAL, center=CENTER, k=K, terms=TERMS, composition=how),
        )
        for how in ("sequential", "additive")
    },
    "thin prism without terms": (
        lens(ThinPrismFisheyeCamera, K, [0.0] * 2, [0.0] * 4), 100, lambda rays: kannala_brandt(rays, *PLANE, *K)
    ),
    **{
        f"fisheye {name}": (
            FisheyeCamera(name, *double(FOCAL, CENTER), SIZE), 85 if name == "orthographic" else 172,
            partial(radial, radius=radius),
        )
        for name, radius in RADII.items()
    },
    "double sphere": (lens(DoubleSphereCamera, -0.28, 0.57), 110, partial(two_spheres, xi=-0.28, alpha=0.57)),
    "double sphere without spheres": (
        lens(DoubleSphereCamera, 0.0, 0.0), 60, partial(opencv_plain, matrix=MATRIX, distortion=[0.0] * 4)
    ),
    **{
        f"unified, {xi}, {k}": (
            unified(xi, k), 60, partial(opencv_omnidir, matrix=MATRIX, xi=xi, distortion=k or [0.0] * 4)
        )
        for xi in (0.0, 0.3, 1.0, KITTI[0])
        for k in (None, MEI)
    },
    "mei past 90°": (unified(*KITTI), 110, partial(radial, radius=mei_radius)),
    **{
        f"unified is extended of β = 1, {xi}": (
            unified(xi, focal=[(1 + xi) * f for f in FOCAL]), 85,
            lambda rays, xi=xi: extended_unified(rays, *PLANE, xi / (1 + xi), 1.0),
        )
        for xi in (0.4, 1.0, 2.5)
    },
    "extended unified": (lens(ExtendedUnifiedCamera, *TUM), 110, lambda rays: extended_unified(rays, *PLANE, *TUM)),
    "atan": (
        lens(AtanCamera, 0.93), 85,
        partial(radial, radius=lambda angle: np.arctan(2 * np.tan(angle) * np.tan(0.93 / 2)) / 0.93),
    ),
    "division by the quadratic formula": (
        lens(DivisionCamera, [-0.2]), 80,
        partial(radial, radius=lambda a: 2 * np.tan(a) / (1 + np.sqrt(1 + 0.8 * np.tan(a) ** 2))),
    ),
    **{
        f"radial polynomial, {len(p)}": (
            RadialPolynomialCamera(*double(p, CENTER, 1.1), SIZE), degrees,
            partial(radial, radius=powers(p, 1), scale=(1.0, 1.1)),
        )
        for p, degrees in ((WOODSCAPE, 150), ([300.0], 170), ([300.0, -40.0], 170), ([300.0, 0, -9.0, 0, 0.4], 110))
    },
    "radial polynomial of odd powers": (
        RadialPolynomialCamera(*double(ODD, CENTER, 1.0), SIZE), 105,
        lambda rays: kannala_brandt(rays, 240.0, 240.0, *CENTER, *K[:3]),
    ),
    "ocam by its inverse polynomial": (ocam(DIRECT, INVERSE), 105, inverse_of_files),
    "ocam of degree two is stereographic": (
        ocam([-300.0, 0.0, 1 / 1200], affine=[1.0, 0.0, 0.0]), 105,
        partial(radial, radius=RADII["stereographic"], scale=(300.0, 300.0)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", PROJECTS)
def test_a_model_is_its_formula(name: str) -> None:
    camera, degrees, oracle = PROJECTS[name]
    rays = directions(degrees, rings=23)
    pixels = oracle(rays)
    assert camera._project(torch.from_numpy(rays)).valid.all()
    assert_projects(camera, pixels, rays, 1e-7 if "ocam" in name else 1e-8)
    if name != "ocam by its inverse polynomial":
        found, valid = camera._unproject(torch.from_numpy(pixels))
        assert valid.all()
        np.testing.assert_allclose(found.numpy(), rays, rtol=0, atol=1e-8)


# Models that define the ray of a pixel --------------------------------------------------------------------------------

SPIRAL = np.stack((np.cos(2.4 * np.arange(60)), np.sin(2.4 * np.arange(60))), -1)
RADIUS = np.linspace(1e-6, 1.9, 60)[:, None]


def by_direct_polynomial(direct: list[float]) -> tuple[Camera, np.ndarray, np.ndarray]:
    """The ray of (row', col') is (col', row', −f(ρ))."""
    ideal, (c, d, e) = SPIRAL * RADIUS * 300, AFFINE
    pixels = np.stack((e * ideal[:, 1] + ideal[:, 0], c * ideal[:, 1] + d * ideal[:, 0]), -1) + CENTER
    return ocam(direct), pixels, np.column_stack((ideal, -powers(direct)(np.hypot(*ideal.T))))


def by_angle(k: list[float]) -> tuple[Camera, np.ndarray, np.ndarray]:
    """At the image radius ρ the angle is ρ (1 + k1 ρ + ...), past 90°."""
    theta = RADIUS * (1 + powers(k, 1)(RADIUS))
    assert theta.max() > np.radians(110)
    return (
        lens(AnglePolynomialCamera, k),
        SPIRAL * RADIUS * FOCAL + CENTER,
        np.column_stack((np.sin(theta) * SPIRAL, np.cos(theta))),
    )


def by_division(k: list[float]) -> tuple[Camera, np.ndarray, np.ndarray]:
    plane = SPIRAL * RADIUS * 0.9
    below = 1 + powers(k, 1)((plane * plane).sum(-1))
    return lens(DivisionCamera, k), plane * FOCAL + CENTER, np.column_stack((plane, below))


LOOKS = {
    **{
        f"ocam, {len(p)}": by_direct_polynomial(p)
        for p in (DIRECT, [-300.0, 0, 8e-4], [-300.0, 0, 8e-4, 0, 1e-10, 0, 1e-18])
    },
    "angle polynomial": by_angle([-0.004, 0.03, -0.002, 0.0005]),
    **{f"division, {k}": by_division(k) for k in ([-0.2], [0.05], [-0.2, 0.01, -0.001])},
}


@pytest.mark.parametrize("name", LOOKS)
def test_a_pixel_looks_along_its_formula(name: str) -> None:
    camera, pixels, rays = LOOKS[name]
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    found, valid = camera._unproject(torch.from_numpy(pixels))
    assert valid.all()
    np.testing.assert_allclose(found.numpy(), rays, rtol=0, atol=1e-12)
    assert_projects(camera, pixels, rays, 1e-7)


# Where models end -----------------------------------------------------------------------------------------------------


def folded(slope: Callable[[np.ndarray], Any]) -> Callable[[np.ndarray], Any]:
    """r − r³ / 3 of the plane's radius."""
    return lambda angle: slope(angle) - slope(angle) ** 3 / 3


def ellipsoid(alpha: float, beta: float) -> Callable[[np.ndarray], Any]:
    return lambda a: (
        np.sin(a) / (alpha * np.sqrt(beta * np.sin(a) ** 2 + np.cos(a) ** 2) + (1 - alpha) * np.cos(a))
    )


def spheres(xi: float, alpha: float) -> Callable[[np.ndarray], Any]:
    return lambda a: (
        np.sin(a) / (alpha * np.hypot(np.sin(a), np.cos(a) + xi) + (1 - alpha) * (np.cos(a) + xi))
    )


def fisheye(projection: str) -> Camera:
    return FisheyeCamera(projection, *double(FOCAL, CENTER), (4001, 4001))


FOLD = [-1 / 3, 0.0, 0.0, 0.0]
# Camera, image radius in focal lengths of an angle
ENDS: dict[str, tuple[Camera, Callable[[np.ndarray], Any]]] = {
    "kannala brandt": (lens(KannalaBrandtCamera, FOLD), folded(lambda t: t)),
    "brown conrady": (
        lens(BrownConradyCamera, FOLD),
        folded(lambda t: np.where(t < math.pi / 2, np.tan(t), 9)),
    ),
    "mei": (unified(1.0, FOLD), folded(lambda t: np.tan(t / 2))),
    "radial polynomial": (
        RadialPolynomialCamera(*double([300.0, -100.0], CENTER, 1.0), SIZE),
        lambda t: 3 * t - t * t,
    ),
    **{name: (fisheye(name), RADII[name]) for name in ("equidistant", "equisolid", "orthographic")},
    **{
        f"unified, {xi}": (unified(xi), lambda a, xi=xi: np.sin(a) / (np.cos(a) + xi))
        for xi in (-0.4, 0.0, 0.5, 1.0, 1.01, 2.0)
    },
    **{
        f"extended unified, {a}, {b}": (lens(ExtendedUnifiedCamera, a, b), ellipsoid(a, b))
        for a, b in ((0.3, 1.4), (0.5, 0.8), (0.63, 1.04), (0.75, 2.0), (1.0, 0.5))
    },
}


@pytest.mark.parametrize("name", ENDS)
def test_ends_where_the_radius_stops_growing(name: str) -> None:
    """Up to the pole of its formula, or its maximum: for directions, for pixels, and by default."""
    camera, formula = ENDS[name]
    angle = np.linspace(0, math.pi, 20001)[1:-1]
    radius = formula(angle)
    seen = np.logical_and.accumulate(np.diff(radius, prepend=0.0) > 0)
    assert (camera._project(circle(torch.from_numpy(angle)) * 3.0).valid.numpy() != seen).sum() <= 8
    assert camera.max_angle.item() == pytest.approx(angle[seen].max(), abs=1e-3)
    largest = radius[seen].max()
    if largest < 20:  # no pole
        along = torch.tensor([0.999, 1.001, 1.2, 30.0])[:, None].double() * largest * torch.tensor([1.0, 0.0])
        scale = FOCAL if name != "radial polynomial" else [100.0, 100.0]
        directions, valid = camera._unproject(double(CENTER)[0] + along * double(scale)[0])
        assert valid.tolist() == [True, False, False, False]
        torch.testing.assert_close(directions.norm(dim=-1), torch.ones(4).double())


@pytest.mark.parametrize(("xi", "alpha"), [(-0.28, 0.57), (0.3, 0.7), (0.3, 0.2)])
def test_double_spheres_end_where_their_paper_says(xi: float, alpha: float) -> None:
    """Less than three degrees before the radius stops growing."""
    angle = np.linspace(0, math.pi, 20001)[1:-1]
    seen = np.logical_and.accumulate(np.diff(spheres(xi, alpha)(angle), prepend=0.0) > 0)
    valid = lens(DoubleSphereCamera, xi, alpha)._project(circle(torch.from_numpy(angle)) * 3.0).valid.numpy()
    assert not (valid & ~seen).any()
    assert 0 < (seen & ~valid).sum() < 300


def test_a_polynomial_that_bends_back_ends_the_view_of_ocam() -> None:
    """tan θ = ρ / (100 + 0.04 ρ²) is largest at ρ = 50; without one the view ends beyond the image's corners."""
    pixels = torch.tensor([[CENTER[0] + radius, CENTER[1]] for radius in (0.0, 49.0, 51.0, 400.0)]).double()
    folding = ocam([-100.0, 0.0, -0.04], affine=[1.0, 0.0, 0.0], angle=math.pi)
    assert folding.unproject(pixels).valid.tolist() == [True, True, False, False]
    assert not folding.project(torch.tensor([1.0, 0.0, 0.0])).valid
    bent = OCamCamera(double([-100.0, 0.0, -0.04])[0], None, CENTER, [1.0, 0.0, 0.0], SIZE)
    assert float(bent.max_angle) == pytest.approx(math.atan(50 / 200), abs=1e-6)
    corners = torch.tensor([[-0.4, -0.4], [639.4, -0.4], [-0.4, 479.4], [639.4, 479.4]], dtype=torch.float64)
    for affine in ([1.0, 0.0, 0.0], [0.5, 0.0, 0.0], [2.0, 0.0, 0.0], [1.0, 0.3, 0.3], [0.7, 0.4, 0.1]):
        whole = OCamCamera(double([-100.0, 0.0, 0.0025])[0], None, [319.5, 239.5], affine, (480, 640))
        rays, valid = whole.unproject(corners)
        back, seen = whole.project(rays)
        assert (valid & seen).all()
        torch.testing.assert_close(back, corners)


@pytest.mark.parametrize("scale", [1e-12, 1e-8, 1e-5, 1e-3, 1e-2])
def test_exact_inverse_of_ocam_is_precise_next_to_the_axis_in_float32(scale: float) -> None:
    """There an image radius is the angle times the focal length −a0."""
    near_axis = OCamCamera(DIRECT, None, [0.0, 0.0], [1.0, 0.0, 0.0], (1532, 1600), 1.9)
    pixel = near_axis.project(torch.tensor([scale, 0.0, 1.0])).pixels
    assert pixel[0].item() == pytest.approx(392.2 * scale, rel=1e-4)


def test_atan_goes_on_beyond_90_degrees() -> None:
    angle = torch.linspace(0.01, 3.1, 500, dtype=torch.float64)
    radii = lens(AtanCamera, 0.93).project(circle(angle, 0.0)).pixels[:, 0] - CENTER[0]
    assert (radii.diff() > 0).all()
    assert radii[-1] < FOCAL[0] * math.pi / 0.93


# Other programs and models --------------------------------------------------------------------------------------------

COLMAP: dict[str, tuple[Camera, list[float]]] = {
    "FOV": (lens(AtanCamera, 0.93), [0.93]),
    "DIVISION": (lens(DivisionCamera, [-0.2]), [-0.2]),
    "THIN_PRISM_FISHEYE": (
        lens(
            ThinPrismFisheyeCamera, K[:4], TERMS[:2], [TERMS[2], 0.0, TERMS[4], 0.0], composition="additive"
        ),
        [*K[:2], *TERMS[:2], *K[2:4], TERMS[2], TERMS[4]],
    ),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        lens(ThinPrismFisheyeCamera, K, TERMS[:2], TERMS[2:]),
        [*K, TERMS[1], TERMS[0], *TERMS[2:]],
    ),
}


@pytest.mark.parametrize("model", COLMAP)
def test_colmaps_own_lenses_agree(model: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    camera, more = COLMAP[model]
    theirs = pycolmap.Camera(model=model, width=1000, height=600, params=[*FOCAL, 500.0, 300.0, *more])
    rays = directions(70.0)[1:]
    assert_projects(camera, np.stack([theirs.img_from_cam(ray) for ray in rays]) - 0.5, rays)


def small(model: type[Camera], focal: float, *intrinsics: Any) -> Camera:
    return model([focal, 0.99 * focal], [55.2, 47.1], *intrinsics[:-1], (96, 112), intrinsics[-1])


@pytest.mark.parametrize(
    ("source", "to", "bound"),
    [
        (small(AtanCamera, 26.0, 0.93, 1.3), "kannala_brandt", 0.02),
        (small(DivisionCamera, 30.0, [-0.22], None), "kannala_brandt", 0.02),
        (small(KannalaBrandtCamera, 24.0, [-0.03, 0.0, 0.0, 0.0], 1.3), "division", 0.1),
        (small(KannalaBrandtCamera, 24.0, [-0.06, 0.0, 0.0, 0.0], 0.9), "atan", 0.5),
        (small(KannalaBrandtCamera, 24.0, [-0.03, 0.0, 0.0, 0.0], 1.5), "thin_prism_fisheye", 1e-3),
    ],
)
def test_conversion_to_and_from_wide_models(source: Camera, to: str, bound: float) -> None:
    assert convert(source, to=to).max_error < bound
