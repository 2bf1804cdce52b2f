# SPDX-License-Identifier: Apache-2.0
"""Rigs from boards alone: boards upside down, views that contradict each other, and corners that are wrong."""

from __future__ import annotations

import math
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, FisheyeCamera
from sphericalvision.capture import calibrate_rig
from sphericalvision.capture.calibrating.calibrate import _check_agreement, _half_turn, _poses, _turned
from sphericalvision.capture.calibrating.refine import FEWEST, _Bundle, refine_rig
from sphericalvision.core import ArgumentError
from sphericalvision.geometry import angle_from_axis, transform_from_axis_angle, transform_points

SIZE = (240, 240)
LENS = FisheyeCamera.from_field_of_view(SIZE, 2.0, dtype=torch.float64)
OPTIONS: dict[str, Any] = {"model": FisheyeCamera, "projection": "equidistant", "field_of_view": 2.0}


def grid_of(columns: int, rows: int) -> Tensor:
    """Inner corners of a board with squares of five centimetres, row by row."""
    y, x = torch.meshgrid(torch.arange(rows).double(), torch.arange(columns).double(), indexing="ij")
    return 0.05 * torch.stack((x, y, 0 * x), -1).reshape(-1, 3)


def truth(cameras: int = 2) -> CameraRig:
    """Cameras beside each other, the second one upside down."""
    step = torch.arange(cameras).double()
    turns = torch.stack((0.02 * step, 0.05 * step, torch.where(step == 1, math.pi, 0.03 * step)), -1)
    poses = transform_from_axis_angle(turns, torch.stack((0.1 * step, 0 * step, 0.01 * step), -1))
    return CameraRig([LENS] * cameras, poses)


def seen_by(rig: CameraRig, board: Tensor, views: int = 8, noise: float = 0.05) -> tuple[Tensor, Tensor]:
    """Pixels (n, cameras, m, 2) of a board held in several ways, and which are in view."""
    step = torch.arange(views).double()
    tilt = torch.stack((0.6 * (2.1 * step).sin(), 0.6 * (1.3 * step).cos(), 0.5 * step.sin()), -1)
    away = torch.stack((0.25 * (1.7 * step).sin(), 0.25 * (2.9 * step).cos(), 0.4 + 0.02 * step), -1)
    where = transform_points(transform_from_axis_angle(tilt, away), board - board.mean(0))
    projection = rig.project(where.reshape(-1, 3))
    shape = (len(rig), views, len(board))
    pixels = projection.pixels.reshape(*shape, 2).movedim(0, 1)
    generator = torch.Generator().manual_seed(0)
    pixels = pixels + noise * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    return pixels, projection.valid.reshape(shape).movedim(0, 1)


def calibrated(board: Tensor, pixels: Tensor, seen: Tensor) -> Any:
    sizes = {f"cam{place}": SIZE for place in range(pixels.shape[1])}
    return calibrate_rig(board, pixels, sizes, seen=seen, **OPTIONS)


def assert_poses(result: CameraRig, rig: CameraRig, atol: float = 5e-3) -> None:
    expected = rig.world_from_camera[0].inverse() @ rig.world_from_camera
    torch.testing.assert_close(result.world_from_camera.double(), expected, rtol=0, atol=atol)


def test_a_board_counted_from_its_other_end_is_told_by_its_poses() -> None:
    """By one camera never, always or sometimes; errors stay beside the pixels that they are of."""
    rig, board = truth(3), grid_of(8, 6)
    straight = calibrated(board, *seen_by(rig, board))
    assert straight.rms_error < 0.1
    assert_poses(straight.rig, rig)
    for views in ([0, 1, 2, 3, 4, 5, 6, 7], [1, 4]):
        pixels, seen = seen_by(rig, board)
        pixels[views, 1], seen[views, 1] = pixels[views, 1].flip(1), seen[views, 1].flip(1)
        result = calibrated(board, pixels, seen)
        assert_poses(result.rig, rig)
        back = result.residuals.clone()
        back[views, 1] = back[views, 1].flip(1)
        torch.testing.assert_close(back, straight.residuals, rtol=0, atol=1e-3)


@pytest.mark.parametrize(("cameras", "turned"), [(2, True), pytest.param(3, False, marks=pytest.mark.slow)])
def test_cameras_that_contradict_each_other_are_refused(cameras: int, turned: bool) -> None:
    """A square board turned by 90°, or views of other moments: each camera explains its own."""
    pixels, seen = seen_by(truth(cameras), grid_of(5, 5))
    places = torch.arange(25).reshape(5, 5).rot90().flatten()
    for values in (pixels, seen):
        values[:, 1] = values[:, 1, places] if turned else values[:, 1].roll(3, 0)
    with pytest.raises(
        ArgumentError, match=r"cam\d contradicts the other cameras: alone its views fit to 0\."
    ):
        calibrated(grid_of(5, 5), pixels, seen)


@pytest.mark.parametrize(("error", "used", "fits"), [(1.4, 20, True), (1.6, 20, False), (1.4, 9, False)])
def test_five_times_the_own_error_or_half_left_out_is_a_contradiction(
    error: float, used: int, fits: bool
) -> None:
    residuals = torch.zeros(1, 1, 20, 2)
    residuals[:, :, :used] = error * torch.tensor([0.6, 0.8])
    refined: Any = SimpleNamespace(residuals=residuals)
    with nullcontext() if fits else pytest.raises(ArgumentError):
        _check_agreement(["a"], refined, torch.ones(1, 1, 20, dtype=torch.bool), [0.3])


def test_corners_that_are_wrong_are_left_out() -> None:
    """Three of them, by thirty pixels: poses are those of the others, and what is left out has no error."""
    rig, board = truth(), grid_of(9, 6)
    pixels, seen = seen_by(rig, board)
    pixels[0, 1, :3] += torch.tensor([30.0, -20.0])
    result = calibrated(board, pixels, seen)
    assert result.rms_error < 0.1
    assert (result.residuals[0, 1, :3] == 0).all()
    assert_poses(result.rig, rig)
    seen[0, 1, :3] = False
    for place, camera in enumerate(result.rig.cameras.values()):  # a lens ends 5 % beyond what was seen
        farthest = angle_from_axis(LENS.unproject(pixels[:, place][seen[:, place]]).directions).max()
        torch.testing.assert_close(camera.max_angle.double(), 1.05 * farthest, rtol=5e-3, atol=0)


FOUR = [(0, 1), (3, 2), (5, 1), (6, 0)]


@pytest.mark.parametrize(
    ("astray", "shift"), [([(0, 1)], [30.0, 0.0]), (FOUR, [5.0, 5.0]), (FOUR, [-20.0, 30.0])]
)
def test_a_board_that_moved_between_two_pictures_is_left_out(
    astray: list[tuple[int, int]], shift: list[float]
) -> None:
    """As a whole, by some pixels in one camera: it moves no pose, and has no error, however it is counted."""
    rig, board = truth(3 if astray is FOUR else 2), grid_of(8, 6)
    pixels, seen = seen_by(rig, board)
    for view, place in astray:
        pixels[view, place] += torch.tensor(shift)
    pixels[4, 1], seen[4, 1] = pixels[4, 1].flip(0), seen[4, 1].flip(0)
    result = calibrated(board, pixels, seen)
    assert result.rms_error < 0.1
    assert_poses(result.rig, rig)
    gone = (result.residuals.abs().sum(-1) == 0).all(-1) & seen.any(-1)
    assert sorted(map(tuple, gone.nonzero().tolist())) == sorted(astray)


def test_a_pair_of_cameras_starts_where_most_views_say() -> None:
    """The first view that they share may be of two moments."""
    rig = truth()
    views = transform_from_axis_angle(torch.rand(5, 3).double(), torch.rand(5, 3).double())
    inverse = torch.linalg.inv(rig.world_from_camera.double())
    poses = {name: dict(enumerate(pose @ views)) for name, pose in zip("ab", inverse, strict=True)}
    poses["b"][0] = poses["b"][3]
    alone = {name: (LENS, views) for name, views in poses.items()}
    expected = rig.world_from_camera[0].inverse() @ rig.world_from_camera
    for half_turn in (None, torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))):
        torch.testing.assert_close(_poses(["a", "b"], alone, half_turn), expected, atol=1e-6, rtol=0)


def test_masks_stay_and_the_camera_that_sees_most_says_where_the_object_stood() -> None:
    """Corners of the other one may be few and wrong."""
    masks = {"cam1": torch.rand(SIZE) > 0.5}
    rig, board = truth().replaced(masks=masks), grid_of(9, 6)
    pixels, seen = seen_by(rig, board, noise=0.0)
    assert torch.equal(refine_rig(rig, board, pixels, seen).rig.masks["cam1"], masks["cam1"])
    pixels, seen = seen_by(truth(), board, noise=0.0)
    right = _Bundle(rig, board, pixels, seen, [[], []]).world_from_points
    seen[:, 0, FEWEST:], pixels[:, 0] = False, pixels[:, 0].flip(1)
    found = _Bundle(rig, board, pixels, seen, [[], []]).world_from_points
    torch.testing.assert_close(found, right, atol=1e-4, rtol=0)


@pytest.mark.parametrize(("ratio", "is_turned"), [(0.1, True), (0.5, False)])
def test_a_view_counts_as_turned_only_where_poses_agree_far_better_then(
    ratio: float, is_turned: bool
) -> None:
    """The second camera's object is half a turn away, and off along the axis by a ratio of that."""
    half_turn = _half_turn(grid_of(8, 6))
    assert half_turn is not None
    eye = torch.eye(4, dtype=torch.float64)
    back = half_turn.inverse()
    back[2, 3] += ratio / math.sqrt(1 - ratio**2) * (back - eye).norm()
    alone = {"cam0": (LENS, {0: eye}), "cam1": (LENS, {0: back})}
    turned = _turned(torch.stack((eye, eye)), alone, half_turn)
    assert turned == ([(0, 1)] if is_turned else [])
