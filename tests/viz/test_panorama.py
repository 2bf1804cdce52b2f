# SPDX-License-Identifier: Apache-2.0
"""Panoramas from icospheres and from a rig's images, and their pictures on disk."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.icosphere import Icosphere
from sphericalvision.sphere import Equirectangular
from sphericalvision.viz import depth_to_color, error_panorama, error_to_color, rgb_panorama
from sphericalvision.viz.panorama import (
    confidence_strength,
    depth_panorama,
    icosphere_to_panorama,
)

HALF = torch.tensor([2.0, 1.2, 4.0])


def wall_color(points: Tensor) -> Tensor:
    """Smooth colours (*, 3) in [0, 1] painted on the walls of a box."""
    return (1 + torch.sin(points * torch.tensor([1.0, 1.5, 0.7]))) / 2


def box_depth(origin: Tensor, directions: Tensor) -> Tensor:
    """Distance to the walls of the box |x| <= HALF, from a point inside, worked out wall by wall."""
    return ((torch.copysign(HALF, directions) - origin) / directions).amin(-1)


@pytest.fixture
def rig() -> CameraRig:
    return ring_rig(4, 0.3, (200, 200))


def paint(rig: CameraRig) -> dict[str, Tensor]:
    images = {}
    for (name, camera), world_from_camera in zip(rig.cameras.items(), rig.world_from_camera, strict=True):
        rows, columns = torch.meshgrid(*map(torch.arange, camera.image_size), indexing="ij")
        rays = camera.unproject(torch.stack((columns, rows), dim=-1).float()).directions
        rays = rays @ world_from_camera[:3, :3].T
        origin = world_from_camera[:3, 3]
        colors = wall_color(origin + box_depth(origin, rays)[..., None] * rays)
        images[name] = colors.nan_to_num(0.0).movedim(-1, 0)
    return images


def test_a_linear_function_stays_nearly_linear_on_the_way_to_a_panorama() -> None:
    values = Icosphere(5).vertices.T
    panorama = icosphere_to_panorama(values, height=64)
    assert panorama.shape == (3, 64, 128)
    assert panorama.dtype == values.dtype
    torch.testing.assert_close(
        panorama, Equirectangular(64, 128).directions.movedim(-1, 0), rtol=0, atol=1e-3
    )


def test_at_the_right_depth_all_cameras_agree_on_the_colours(rig: CameraRig) -> None:
    directions = Equirectangular(64, 128).directions
    depth = box_depth(torch.zeros(3), directions)
    expected = wall_color(depth[..., None] * directions).movedim(-1, 0)
    colors, seen = rgb_panorama(rig, paint(rig), 64, depth)
    assert seen.all()
    assert (colors - expected).abs().max() < 0.05
    at_infinity, _ = rgb_panorama(rig, paint(rig), 64)
    assert (at_infinity - expected).abs().mean() > 5 * (colors - expected).abs().mean()


def test_what_no_camera_sees_is_black_and_marked(rig: CameraRig) -> None:
    front = CameraRig({"cam1": rig.cameras["cam1"]}, rig.world_from_camera[:1])
    colors, seen = rgb_panorama(front, {"cam1": paint(rig)["cam1"]}, 32)
    directions = Equirectangular(32, 64).directions
    angle = torch.atan2(directions[..., :2].norm(dim=-1), directions[..., 2])
    assert torch.equal(seen, angle <= math.radians(110))
    assert (colors[:, ~seen] == 0).all()


def test_pictures_are_the_colours_above_a_scale() -> None:
    depth = box_depth(torch.zeros(3), Equirectangular(320, 640).directions)
    for picture, colors in (
        (depth_panorama(depth, 0.55), depth_to_color(depth, 0.55)),
        (error_panorama(depth, 5.0, "error (m)"), error_to_color(depth, 5.0)),
    ):
        np.testing.assert_array_equal(picture[:320], colors)
        assert picture.shape[0] > 350  # the scale


def test_depth_fades_to_grey_where_little_is_known() -> None:
    depth = torch.linspace(0.6, 4.0, 640).expand(12, 640)
    strength = torch.tensor([1.0, 0.5, 0.0]).repeat_interleave(4)[:, None].expand(12, 640)
    plain, faded = depth_panorama(depth, 0.5), depth_panorama(depth, 0.5, strength=strength)
    np.testing.assert_array_equal(faded[:4], plain[:4])
    np.testing.assert_allclose(faded[4:8].astype(float), (plain[4:8].astype(float) + 128) / 2, atol=1)
    assert (faded[8:12] == 128).all()
    assert faded.shape == plain.shape
    legend = faded[12:40, 200:440].astype(float)  # fades downwards, too
    spread = np.abs(legend - legend.mean(-1, keepdims=True)).mean((1, 2))
    assert spread[6] > 3 * spread[15] > 0


def test_what_is_unsure_is_grey_and_what_two_cameras_do_not_see_is_greyer() -> None:
    confidence = torch.linspace(0, 1, 11)
    seen = torch.ones(11, dtype=torch.bool)
    strength = confidence_strength(confidence, seen)
    assert (strength.diff() >= 0).all()
    assert 0 < strength[0] < 0.2
    assert strength[-1] == 1
    assert (confidence_strength(confidence, ~seen) == 0).all()
