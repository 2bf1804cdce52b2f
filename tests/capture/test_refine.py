# SPDX-License-Identifier: Apache-2.0
"""Intrinsics and poses are found again from what boards look like, for every model, and from rendered pictures."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import (
    Camera,
    CameraRig,
    EquirectangularCamera,
    KannalaBrandtCamera,
    OCamCamera,
    ring_rig,
)
from sphericalvision.cameras.models.ocam_polynomials import fit_inverse_polynomial
from sphericalvision.capture import calibrate_camera, refine, refine_rig
from sphericalvision.capture.calibrating.board_pose import pose_from_directions
from sphericalvision.capture.calibrating.refine import _finished
from sphericalvision.geometry import angle_from_axis, transform_from_axis_angle, transform_points
from tests.laws.camera_laws import arguments_of
from tests.laws.cameras import CAMERAS, CameraCase

BOARD = torch.cartesian_prod(torch.arange(7.0), torch.arange(5.0), torch.zeros(1)).double() * 0.04
BOARD = BOARD - BOARD.mean(0)
LENSES = [case for case in CAMERAS if not isinstance(case.make(1.0), EquirectangularCamera)]


def poses(max_angle: float, count: int = 10, distance: float = 0.35) -> Tensor:
    """Boards all over a field of view, each turned towards the camera and tilted, (count, 4, 4)."""
    step = torch.arange(count, dtype=torch.float64)
    angle, azimuth = 0.75 * max_angle * ((step + 0.3) / count).sqrt(), 2.4 * step
    vector = torch.stack((-azimuth.sin() * angle, azimuth.cos() * angle, 0 * step), -1)
    towards = transform_from_axis_angle(vector, torch.zeros_like(vector))
    tilt = torch.stack((0.6 * (3.1 * step).sin(), 0.6 * (1.7 * step).cos(), 0.9 * step), -1)
    shift = torch.tensor([[0.0, 0.0, distance]]).double().expand(count, 3)
    return towards @ transform_from_axis_angle(tilt, shift)


def seen_boards(camera: Camera, count: int = 10) -> tuple[Tensor, Tensor, Tensor]:
    """Poses, pixels and what is seen."""
    where = poses(float(camera.max_angle), count, 0.35 if camera.max_angle > 0.9 else 0.8)
    pixels, valid = camera.project(transform_points(where, BOARD))
    return where, pixels, valid


def changed(camera: Camera, share: float) -> Camera:
    """The camera with focal lengths and the centre a little off."""
    given = arguments_of(camera)
    for name in ("focal_length", "principal_point"):
        if given.get(name) is not None:
            given[name] = given[name] * (1 + share)
    return type(camera)(**given)


@pytest.mark.parametrize("case", LENSES, ids=lambda case: case.name)
def test_intrinsics_are_found_again(case: CameraCase) -> None:
    """From half a percent off, without noise, to a thousandth of a pixel wherever boards were seen."""
    truth = case.make(1.0).to(torch.float64)
    _, pixels, seen = seen_boards(truth.exact() if hasattr(truth, "exact") else truth)
    assert seen.sum() > 100
    found = refine(changed(truth, 0.005), BOARD, pixels, seen)
    assert found.rms_error < 1e-3
    assert found.residuals[seen].norm(dim=-1).max() < 1e-2
    # Turns its image about the axis, which boards cannot tell from their own turn
    if case.name.startswith("ocam"):
        return
    counted = seen & (seen.sum(-1, keepdim=True) >= 6)
    rays = transform_points(found.camera_from_points, BOARD)[counted]
    expected = truth.project(rays).pixels
    torch.testing.assert_close(found.camera.project(rays).pixels, expected, rtol=0, atol=1e-2)


def test_noise_is_what_remains() -> None:
    """A tenth of a pixel in each coordinate: as much is left, and the intrinsics are as good as it allows."""
    distortion = [0.01, -0.004, 1e-3, 0.0]
    truth = KannalaBrandtCamera([190.0, 191.0], [255.0, 257.0], distortion, (512, 512), 1.6).to(torch.float64)
    _, pixels, seen = seen_boards(truth, 20)
    noise = 0.1 * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = refine(changed(truth, 0.02), BOARD, pixels + noise, seen)
    assert found.rms_error == pytest.approx(0.1 * 2**0.5, rel=0.1)
    assert (found.camera.focal_length - truth.focal_length).abs().max() < 0.5
    assert found.camera.max_angle == truth.max_angle


def test_what_is_fixed_stays() -> None:
    truth = KannalaBrandtCamera([190.0, 191.0], [255.0, 257.0], [0.01, 0.0, 0.0, 0.0], (512, 512), 1.6)
    _, pixels, seen = seen_boards(truth.to(torch.float64))
    start = changed(truth, 0.01)
    found = refine(start, BOARD, pixels, seen, fixed=("distortion", "principal_point"))
    assert torch.equal(found.camera.distortion, start.distortion)
    assert torch.equal(found.camera.principal_point, start.principal_point)
    assert not torch.equal(found.camera.focal_length, start.focal_length)
    assert found.camera.dtype == torch.float32


@pytest.mark.parametrize("degrees", [10.0, 80.0, 100.0])
def test_poses_are_found_past_90_degrees(degrees: float) -> None:
    turn = torch.tensor([0.2, math.radians(degrees), -0.1], dtype=torch.float64)
    pose = transform_from_axis_angle(turn, torch.zeros(3).double()) @ poses(0.1, 1)[0]
    box = torch.cartesian_prod(*[torch.tensor([-0.1, 0.0, 0.13])] * 3).double()
    for points in (BOARD, box):
        seen = transform_points(pose, points)
        found = pose_from_directions(points, seen / seen.norm(dim=-1, keepdim=True))
        torch.testing.assert_close(found, pose, rtol=0, atol=1e-9)


def knocked(rig: CameraRig, degrees: float) -> CameraRig:
    """Each camera but the first turned about an axis of its own, and shifted by 2 mm."""
    generator = torch.Generator().manual_seed(5)
    axes = torch.nn.functional.normalize(torch.randn(len(rig), 3, generator=generator).double(), dim=-1)
    knocks = transform_from_axis_angle(axes * math.radians(degrees), axes.flip(-1) * 0.002)
    knocks[0] = torch.eye(4)
    return CameraRig(rig.cameras, rig.world_from_camera @ knocks)


def test_a_knocked_rig_is_brought_back() -> None:
    """Half a degree, with half a pixel of noise: to a twentieth of a degree; without noise to the last digits."""
    rig = ring_rig(4, image_size=(640, 640)).to(torch.float64)
    count = 24  # boards around the rig, where two cameras or more see them
    turn = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    zero = torch.zeros_like(turn)
    around = transform_from_axis_angle(torch.stack((zero, turn, zero), -1), torch.zeros(count, 3).double())
    tilt = torch.stack((0.5 * (5 * turn).sin(), 0.5 * (3 * turn).cos(), turn), -1)
    shift = torch.stack((zero, 0.2 * (7 * turn).sin(), zero + 0.8), -1)
    boards = around @ transform_from_axis_angle(tilt, shift)
    projection = rig.project(transform_points(boards, BOARD).reshape(-1, 3))
    pixels = projection.pixels.reshape(4, count, -1, 2).movedim(0, 1)
    seen = projection.valid.reshape(4, count, -1).movedim(0, 1)
    exact = refine_rig(knocked(rig, 0.5), BOARD, pixels, seen)
    torch.testing.assert_close(exact.rig.world_from_camera, rig.world_from_camera, rtol=0, atol=1e-7)
    noise = torch.randn(pixels.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def errors(deviation: float) -> tuple[float, float]:
        found = refine_rig(knocked(rig, 0.5), BOARD, pixels + deviation * noise, seen).rig
        off = angle_from_axis((rig.camera_from_world @ found.world_from_camera)[:, :3, 2])
        return math.degrees(float(off.max())), float((found.positions - rig.positions).norm(dim=-1).max())

    degrees, metres = errors(0.5)
    assert degrees < 0.05
    assert metres < 1e-3
    # That is the statistical error of the noise, whose covariance σ² (JᵀJ)⁻¹ has standard deviations up to 0.06° and
    # 0.7 mm with some 450 points a camera; so a tenth of the noise leaves a tenth of it.
    assert errors(0.05) == pytest.approx((degrees / 10, metres / 10), rel=0.1)


@pytest.mark.parametrize(
    "model",
    [
        "kannala_brandt",
        "double_sphere",
        "brown_conrady",
        pytest.param("extended_unified", marks=pytest.mark.slow),
        pytest.param("unified", marks=pytest.mark.slow),
    ],
)
def test_a_camera_from_boards_alone(model: str) -> None:
    """Nothing is given but the size of the image and a field of view that is a fifth off."""
    angle = 0.7 if model == "brown_conrady" else 1.5
    focal = 420.0 if model == "brown_conrady" else 150.0
    truth = KannalaBrandtCamera([focal, focal], [251.0, 244.0], [-0.01, -0.002, 0.0, 0.0], (480, 512), angle)
    _, pixels, seen = seen_boards(truth.to(torch.float64), 16)
    field = 1.2 * 480 / focal
    found = calibrate_camera(BOARD, pixels, (480, 512), model, seen, field_of_view=field)
    assert found.camera.model == model
    assert found.rms_error < 0.1


def test_two_refinements_keep_the_degree_of_the_inverse_polynomial() -> None:
    case = next(case for case in CAMERAS if case.name == "ocam")
    camera = case.make(1.0).to(torch.float64)
    assert isinstance(camera, OCamCamera)
    if camera.inverse_polynomial is None:
        camera = fit_inverse_polynomial(camera, 7).camera
    again = _finished(_finished(camera.exact(), camera).exact(), camera)
    assert isinstance(again, OCamCamera)
    assert again.inverse_polynomial is not None
    assert camera.inverse_polynomial is not None
    assert len(again.inverse_polynomial) == len(camera.inverse_polynomial)
