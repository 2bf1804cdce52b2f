# SPDX-License-Identifier: Apache-2.0
"""Joints with Kornia: its cameras agree with ours, intrinsics are learned by modules, views and points of images."""

from __future__ import annotations

import math

import pytest
import torch
from kornia.geometry.camera import PinholeCamera as KorniaPinhole
from kornia.geometry.depth import depth_to_3d_v2
from kornia.image import ImageSize
from kornia.sensors.camera import CameraModel, CameraModelType

from sphericalvision.cameras import (
    CameraModule,
    EquirectangularCamera,
    PinholeCamera,
    depth_from_z,
    from_kornia,
    points_from_depth,
    to_kornia,
)
from sphericalvision.capture import refine
from sphericalvision.core import ArgumentError
from sphericalvision.geometry import transform_from_axis_angle, transform_points
from tests.laws.cameras import MODELS

SIZE = (480, 640)


@pytest.mark.parametrize("name", ["pinhole", "brown conrady", "kannala brandt"])
def test_kornias_model_projects_as_ours(name: str) -> None:
    camera = MODELS[name](1.0).to(torch.float64)
    points = torch.tensor([[0.1, 0.2, 1.0], [-0.3, 0.25, 1.5], [0.5, -0.4, 2.0]], dtype=torch.float64)
    theirs = to_kornia(camera)
    assert isinstance(theirs, CameraModel)
    from kornia.geometry.vector import Vector3

    expected = theirs.project(Vector3(points)).data
    torch.testing.assert_close(camera.project(points).pixels, expected, rtol=0, atol=1e-6)
    again = from_kornia(theirs)
    torch.testing.assert_close(again.project(points).pixels, expected, rtol=0, atol=1e-6)
    assert again.image_size == camera.image_size


def test_kornias_pinholes_are_read_without_their_poses() -> None:
    camera = PinholeCamera([500.0, 510.0], [319.5, 239.5], SIZE, skew=2.5)
    matrix = torch.eye(4)
    matrix[0], matrix[1, 1:3] = torch.tensor([500.0, 2.5, 319.5, 0.0]), torch.tensor([510.0, 239.5])
    one, two = (
        KorniaPinhole(
            matrix.expand(n, 4, 4),
            torch.eye(4).expand(n, 4, 4),
            torch.tensor([480] * n),
            torch.tensor([640] * n),
        )
        for n in (1, 2)
    )
    points = torch.tensor([[0.1, 0.2, 1.0], [-0.3, 0.25, 1.5]])
    torch.testing.assert_close(one.project(points[None])[0], camera.project(points).pixels, rtol=0, atol=1e-3)
    assert from_kornia(one).equals(camera)
    assert from_kornia(two).batch_shape == (2,)


def test_a_camera_of_kornias_that_is_not_ours_is_refused() -> None:
    flat = CameraModel(
        ImageSize(480, 640), CameraModelType.ORTHOGRAPHIC, torch.tensor([328.0, 328.0, 320.0, 240.0])
    )
    with pytest.raises(ArgumentError, match="but an orthographic one"):
        from_kornia(flat)


@pytest.mark.parametrize("name", ["kannala brandt", "ocam exact", "thin prism fisheye", "equidistant"])
def test_intrinsics_are_learned_saved_and_moved(name: str) -> None:
    camera = MODELS[name](1.0)
    module = CameraModule(camera)
    names = {key for key in camera.intrinsic_names if getattr(camera, key) is not None}
    assert {key for key, _ in module.named_parameters()} == names
    points = torch.tensor([[0.1, 0.2, 1.0], [0.5, -0.4, 0.7]], dtype=camera.dtype)
    assert torch.equal(module(points).pixels, camera.project(points).pixels)
    module(points).pixels.sum().backward()
    assert all(
        parameter.grad is not None and parameter.grad.isfinite().all() for parameter in module.parameters()
    )
    other = CameraModule(MODELS[name](1.05))
    other.load_state_dict(module.state_dict())
    assert torch.equal(other(points).pixels, module(points).pixels)
    assert module.to(torch.float64).camera.dtype == torch.float64
    fixed = CameraModule(camera, fixed=["principal_point"])
    assert "principal_point" not in dict(fixed.named_parameters())


def test_a_module_and_refine_agree() -> None:
    """Gradient descent on the module's parameters goes where Levenberg-Marquardt ends."""
    truth = PinholeCamera([310.0, 300.0], [159.5, 119.5], (240, 320)).to(torch.float64)
    board = torch.cartesian_prod(torch.arange(5.0), torch.arange(4.0), torch.zeros(1)).double() * 0.05
    turns = torch.tensor([[0.4, 0.2, 0.0], [-0.3, 0.4, 0.1], [0.1, -0.5, 0.2]], dtype=torch.float64)
    poses = transform_from_axis_angle(turns, torch.tensor([[-0.1, -0.08, 0.5]]).double().expand(3, 3))
    pixels = truth.project(transform_points(poses, board)).pixels
    start = PinholeCamera([300.0, 300.0], [159.5, 119.5], (240, 320)).to(torch.float64)
    found = refine(start, board, pixels)
    module = CameraModule(found.camera)
    loss = (module(transform_points(found.camera_from_points, board)).pixels - pixels).square().sum()
    loss.backward()
    for parameter in module.parameters():
        assert parameter.grad is not None
        assert parameter.grad.abs().max() < 1e-5


def test_points_from_depth_are_kornias_for_a_pinhole() -> None:
    camera = PinholeCamera([50.0, 52.0], [19.5, 14.5], (30, 40))
    z = torch.rand(30, 40, generator=torch.Generator().manual_seed(0)) + 0.5
    matrix = torch.tensor([[50.0, 0, 19.5], [0, 52.0, 14.5], [0, 0, 1]])
    points, valid = points_from_depth(depth_from_z(z, camera)[0], camera)
    assert valid.all()
    torch.testing.assert_close(points, depth_to_3d_v2(z[None], matrix[None])[0])
    assert not points_from_depth(
        torch.tensor([[math.inf, 0.0, -1.0, math.nan]]), EquirectangularCamera((1, 4))
    )[1].any()
