# SPDX-License-Identifier: Apache-2.0
"""Conversion: models that are the same lens find each other, and the errors told are the errors made."""

from __future__ import annotations

import math

import pytest
import torch

from sphericalvision.cameras import (
    BrownConradyCamera,
    Camera,
    CameraRig,
    DoubleSphereCamera,
    ExtendedUnifiedCamera,
    FisheyeCamera,
    KannalaBrandtCamera,
    OCamCamera,
    PinholeCamera,
    RadialPolynomialCamera,
    UnifiedCamera,
    compare_cameras,
    convert,
    fit_inverse_polynomial,
    straighten,
    straighten_rig,
)
from sphericalvision.cameras.field_of_view import focal_length_on_axis
from sphericalvision.core import ArgumentError
from tests.laws.camera_laws import circle
from tests.laws.cameras import MODELS

F, C, SIZE = [210.0, 208.0], [318.2, 322.7], (640, 640)
EXACT = 1e-6  # pixels


def double(camera: Camera) -> Camera:
    return camera.to(torch.float64)


def wide_lens() -> DoubleSphereCamera:
    """A lens of 200° like the one of a real capture."""
    lens = DoubleSphereCamera([300.0, 299.8], [609.5, 607.5], -0.2, 0.6, (1216, 1216), math.radians(100))
    return double(lens)


def real_ocam() -> OCamCamera:
    """A lens of 220° whose polynomials have the degrees and sizes of real files: f of degree 4, 1600 x 1532 pixels."""
    direct = [-264.0, 0.0, 8.33e-4, -5.97e-7, 1.01e-9]
    affine = [1.0003, -2.7e-4, -9.2e-4]
    return double(OCamCamera(direct, None, [798.3, 771.6], affine, (1532, 1600), math.radians(110)))


def unseen_directions(camera: Camera, max_angle: float, count: int = 3000) -> torch.Tensor:
    """Random directions within an angle that the camera sees; the conversion knows nothing of them."""
    generator = torch.Generator().manual_seed(7)
    random = torch.rand(2, count, generator=generator, dtype=torch.float64)
    cosine = 1 - (1 - math.cos(max_angle)) * random[0]
    points = circle(cosine.acos(), 2 * math.pi * random[1])
    return points[camera.project(points).valid]


def gap(a: Camera, b: Camera, points: torch.Tensor) -> torch.Tensor:
    return (double(a).project(points).pixels - double(b).project(points).pixels).norm(dim=-1)


@pytest.mark.parametrize("name", MODELS)
def test_a_camera_is_its_own_conversion(name: str) -> None:
    camera = double(MODELS[name](1.0))
    limit = 0.9 * float(camera.max_angle) if "skew" in name else None  # no fit has one
    conversion = convert(camera, to=type(camera), max_angle=limit)
    fitted = {  # an inverse polynomial; the sequential composition, which conversion makes
        "ocam exact": 0.01,
        "thin prism fisheye, additive": 0.05,
    }
    tolerance = fitted.get(name, EXACT)
    assert conversion.max_error < tolerance
    assert conversion.rms_error <= conversion.max_error
    assert type(conversion.camera) is type(camera)
    assert conversion.camera.image_size == camera.image_size
    assert float(conversion.camera.max_angle) == pytest.approx(conversion.covered_angle)


SAME_LENS: dict[str, tuple[Camera, type[Camera], dict[str, object]]] = {
    "double sphere of xi 0 is extended unified": (
        DoubleSphereCamera(F, C, 0.0, 0.55, SIZE, 1.6),
        ExtendedUnifiedCamera,
        {"alpha": 0.55, "beta": 1.0},
    ),
    "extended unified of beta 1 is unified": (
        ExtendedUnifiedCamera(F, C, 0.6, 1.0, SIZE, 1.7),
        UnifiedCamera,
        {"xi": 1.5, "focal_length": [2.5 * f for f in F]},
    ),
    "unified of xi 1 is stereographic": (
        UnifiedCamera([2 * f for f in F], C, 1.0, None, SIZE, 1.9),
        FisheyeCamera,
        {"focal_length": F},
    ),
    "an equidistant lens has no coefficients": (
        FisheyeCamera("equidistant", F, C, SIZE, 1.9),
        KannalaBrandtCamera,
        {"focal_length": F, "distortion": [0.0] * 4},
    ),
    "nor more than one power": (
        FisheyeCamera("equidistant", F, C, SIZE, 1.9),
        RadialPolynomialCamera,
        {"polynomial": [F[0], 0.0, 0.0, 0.0], "aspect_ratio": F[1] / F[0]},
    ),
    "a pinhole is a double sphere of alpha 0": (
        PinholeCamera(F, C, SIZE),
        DoubleSphereCamera,
        {"focal_length": F},
    ),
    "and has no distortion": (PinholeCamera(F, C, SIZE), BrownConradyCamera, {"distortion": [0.0] * 8}),
}


@pytest.mark.parametrize("name", SAME_LENS)
def test_the_same_lens_in_other_words(name: str) -> None:
    """Models that coincide for some parameters are found from starts that know nothing of them."""
    camera, to, expected = SAME_LENS[name]
    options = {"num_coefficients": 0} if to is UnifiedCamera else {}
    conversion = convert(double(camera), to, **options)
    assert conversion.max_error < 1e-5
    for key, value in ({"principal_point": C} | expected).items():
        found = getattr(conversion.camera, key)
        torch.testing.assert_close(found, torch.tensor(value).to(found), atol=1e-4, rtol=1e-6)
    if to is FisheyeCamera:
        assert conversion.camera.projection == "stereographic"


def test_there_and_back_again() -> None:
    """Double sphere to extended unified and back: within what the first of the two conversions said."""
    lens = wide_lens()
    there = convert(lens, to=ExtendedUnifiedCamera)
    back = convert(there.camera, to=DoubleSphereCamera)
    assert there.max_error < 0.3
    points = unseen_directions(lens, lens.max_angle)
    assert gap(lens, back.camera, points).max() <= there.max_error + back.max_error + EXACT
    assert back.camera.focal_length.sub(lens.focal_length).abs().max() < 1.0


TARGETS: dict[type[Camera], float] = {  # pixels of 1216 x 1216, largest
    BrownConradyCamera: 0.15,
    KannalaBrandtCamera: 0.02,
    UnifiedCamera: 0.25,
    ExtendedUnifiedCamera: 0.3,
    DoubleSphereCamera: EXACT,
    FisheyeCamera: 40.0,
    RadialPolynomialCamera: 2.0,
    OCamCamera: 0.01,
    PinholeCamera: 400.0,
}


@pytest.mark.parametrize("to", TARGETS)
def test_the_error_told_is_the_error_made(to: type[Camera]) -> None:
    lens = wide_lens()
    camera, largest, rms, covered = convert(lens, to=to)
    assert type(camera) is to
    assert camera.dtype == lens.dtype
    assert 0 <= rms <= largest < TARGETS[to]
    points = unseen_directions(lens, covered - 1e-9)
    made = gap(lens, camera, points)
    if isinstance(camera, OCamCamera):  # both polynomials count
        made = torch.maximum(made, gap(lens, camera.exact(), points))
        assert camera.polynomial[0] < 0 == camera.polynomial[1]
    assert double(camera).project(points).valid.float().mean() > 0.9, (
        "but for pixels that move out at the border"
    )
    assert made.max() <= 1.05 * largest + 1e-9
    assert made.square().mean().sqrt() == pytest.approx(rms, rel=0.1, abs=1e-9)
    pinhole_like = to in (PinholeCamera, BrownConradyCamera)
    assert math.degrees(covered) == pytest.approx(80 if pinhole_like else 100, abs=1e-6)
    assert float(camera.max_angle) == pytest.approx(covered)


def test_ocam_of_220_degrees_as_kannala_brandt() -> None:
    ocam = real_ocam()
    conversion = convert(ocam, to=KannalaBrandtCamera)
    # The affine part's shear, which Kannala-Brandt lacks, is 0.7 px at the edge
    assert conversion.max_error < 0.8
    upright = ocam.with_intrinsics(affine=ocam.affine.new_tensor([1.0003, 0.0, 0.0]))
    assert convert(upright, to=KannalaBrandtCamera).max_error < 0.15
    assert math.degrees(conversion.covered_angle) == pytest.approx(110)


@pytest.mark.parametrize(("down", "skew"), [(125.0, 0.0), (250.0, 150.0), (200.0, -120.0)])
def test_an_ocam_camera_has_the_axes_of_pixels_that_are_no_squares(down: float, skew: float) -> None:
    lens = KannalaBrandtCamera(
        [250.0, down], [399.5, 299.5], [0.01, -0.002, 0.0003, -1e-4], (600, 800), 1.6, skew=skew
    )
    ocam, largest, _, _ = convert(double(lens), to=OCamCamera)
    assert largest < 0.002
    expected = torch.tensor([down / 250, 0, skew / 250], dtype=torch.float64)
    torch.testing.assert_close(ocam.affine, expected, atol=1e-6, rtol=0)


def test_a_model_that_reaches_but_a_spot_is_refused() -> None:
    """Decentred so much that the polynomial misses the centre by pixels, and ends there."""
    lens = BrownConradyCamera(
        [182.3, 190.2], [258.1, 229.0], [-0.27, -0.009, 0.0094, -0.0036, 0.0126], (475, 515)
    )
    with pytest.raises(ArgumentError, match="a OCamCamera cannot show what this BrownConradyCamera"):
        convert(double(lens), to=OCamCamera)


def test_a_turned_ocam_image_is_off_by_its_turn() -> None:
    """The frame stays, so models that cannot turn the image miss by the turn, and the error says so."""
    ocam = real_ocam()
    turned = ocam.with_intrinsics(affine=ocam.affine.new_tensor([1.0, -0.02, 0.02]))
    pixel = turned.project(torch.tensor([math.sin(1.9), 0.0, math.cos(1.9)])).pixels
    radius = float((pixel - ocam.principal_point).norm())
    assert convert(turned, to=KannalaBrandtCamera).max_error == pytest.approx(0.02 * radius, rel=0.05)


def turned_ocam() -> OCamCamera:
    """By 1.13°, with some shear."""
    ocam = real_ocam()
    return ocam.with_intrinsics(affine=ocam.affine.new_tensor([0.998, 0.021, -0.0185]))


@pytest.mark.parametrize("inverse", [False, True])
def test_a_straightened_lens_is_the_same_lens_in_a_turned_frame(inverse: bool) -> None:
    lens = turned_ocam()
    if inverse:
        lens = fit_inverse_polynomial(lens).camera
    straight, old_from_new, angle = straighten(lens)
    assert abs(math.degrees(angle) - 1.13) < 0.01
    torch.testing.assert_close(old_from_new @ old_from_new.T, torch.eye(3, dtype=torch.float64))
    points = unseen_directions(lens, math.radians(109), 500)
    expected = lens.project(points)
    found = straight.project(points @ old_from_new)
    torch.testing.assert_close(found.pixels, expected.pixels, rtol=0, atol=1e-9)
    assert torch.equal(found.valid, expected.valid)
    again = straighten(straight)
    assert abs(again.angle) < 1e-15
    assert again.camera.equals(straight)


def test_a_rig_takes_the_turns_of_its_images_into_its_poses() -> None:
    """Converted, it sees points of the world where it saw them before; without, it is off by the turn."""
    lens = turned_ocam()
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, :3, :3] = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    poses[:, 0, 3] = torch.tensor([0.1, -0.1], dtype=torch.float64)
    rig = CameraRig([lens, lens], poses)
    straight = straighten_rig(rig)
    torch.testing.assert_close(straight.positions, rig.positions)
    cameras = {name: convert(camera, to="kannala_brandt").camera for name, camera in straight.cameras.items()}
    converted = CameraRig(cameras, straight.world_from_camera)
    points = unseen_directions(lens, math.radians(70), 200) * 3
    before, after = rig.project(points), converted.project(points)
    seen = before.valid & after.valid
    assert seen.sum() > 100
    assert (before.pixels - after.pixels)[seen].abs().max() < 2
    assert convert(lens, to="kannala_brandt").max_error > 12


def test_a_polynomial_that_misses_the_centre_is_converted() -> None:
    """Inverse polynomials of real files are some tenths of a pixel at the axis instead of 0."""
    lens = wide_lens()
    ocam = convert(lens, to=OCamCamera).camera
    assert isinstance(ocam, OCamCamera)
    inverse = ocam.inverse_polynomial.clone()
    inverse[0] += 0.4
    missing = ocam.with_intrinsics(inverse_polynomial=inverse)
    torch.testing.assert_close(focal_length_on_axis(missing), focal_length_on_axis(ocam), rtol=0.01, atol=0)
    assert convert(missing, to=KannalaBrandtCamera).max_error < 0.45


def test_inverse_polynomial_in_the_convention_of_files() -> None:
    ocam = real_ocam()
    fitted, residual = fit_inverse_polynomial(ocam, tolerance=0.01)
    assert residual <= 0.01
    points = unseen_directions(ocam, float(ocam.max_angle))
    assert gap(ocam, fitted, points).max() <= 1.05 * residual
    for angle in (0.2, 1.0, 1.9):  # the root of the direct polynomial by bisection, against the sum of powers
        low, high = 0.0, 2000.0
        for _ in range(80):
            radius = (low + high) / 2
            value = sum(float(a) * radius**power for power, a in enumerate(ocam.polynomial))
            low, high = (radius, high) if math.atan2(radius, -value) < angle else (low, radius)
        theta = angle - math.pi / 2  # from the image plane
        told = sum(float(b) * theta**power for power, b in enumerate(fitted.inverse_polynomial))
        assert told == pytest.approx(low, abs=0.011)


def test_more_coefficients_fit_better() -> None:
    residuals = [fit_inverse_polynomial(real_ocam(), degree).residual for degree in (3, 6, 9)]
    assert residuals == sorted(residuals, reverse=True)
    fitted, _ = fit_inverse_polynomial(real_ocam(), 6)
    assert len(fitted.inverse_polynomial) == 7
    lens = wide_lens()
    errors = [convert(lens, to="radial_polynomial", num_coefficients=n).max_error for n in (2, 4, 7)]
    assert errors == sorted(errors, reverse=True)


def test_a_smaller_angle_is_fitted_better() -> None:
    lens = wide_lens()
    whole, middle = (convert(lens, to=PinholeCamera, max_angle=math.radians(a)) for a in (70, 30))
    assert middle.max_error < 0.2 * whole.max_error
    assert math.degrees(middle.covered_angle) == pytest.approx(30)
    beyond = convert(lens, to=KannalaBrandtCamera, max_angle=3.0)  # no farther than the lens looks
    assert beyond.covered_angle == pytest.approx(float(lens.max_angle))


@pytest.mark.parametrize("limits", [(1.2, 1.0), (1.0, 1.2)])
def test_cameras_differ_by_what_their_formulas_do(limits: tuple[float, float]) -> None:
    """Equidistant lenses of 100 and 101 pixels a radian, up to the angle that both see."""
    lenses = [
        FisheyeCamera("equidistant", [f, f], [127.5, 127.5], (256, 256), limit)
        for f, limit in zip((100.0, 101.0), limits, strict=True)
    ]
    angles, pixels, max_pixels, turn, max_turn = compare_cameras(*lenses)
    expected = torch.tensor([*(math.radians(10 * k) for k in range(6)), 1.0], dtype=torch.float64)
    torch.testing.assert_close(angles, expected, rtol=0, atol=1e-6)
    for values, slope in ((pixels, 1.0), (max_pixels, 1.0), (turn, 1 / 101), (max_turn, 1 / 101)):
        torch.testing.assert_close(values, slope * angles, rtol=0, atol=1e-5)


def test_cropped_cameras_convert_where_they_look() -> None:
    """The axis lies outside of the crop, which may be a small one."""
    for window in ((0, 0, 500, 560), (350, 100, 150, 150)):
        conversion = convert(wide_lens().cropped(*window), to=KannalaBrandtCamera)
        assert conversion.max_error < 0.05
        assert conversion.camera.image_size == window[2:]


def test_dtype_follows_the_camera() -> None:
    lens = wide_lens().to(torch.float32)
    conversion = convert(lens, to=KannalaBrandtCamera)
    assert conversion.camera.dtype == torch.float32
    assert conversion.max_error < 0.02
