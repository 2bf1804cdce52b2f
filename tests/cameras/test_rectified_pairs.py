# SPDX-License-Identifier: Apache-2.0
"""Rectified pairs: what two cameras see lies in one row, for all pairs of models; disparity is distance."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import (
    CameraRig,
    EquirectangularCamera,
    FisheyeCamera,
    RectifiedPair,
    rectified_pairs,
    ring_rig,
)
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.scenes import make_scene, ray_depth, render_rig
from tests.laws.cameras import CAMERAS

ONE_EACH = {case.make(1.0).model: case.make for case in reversed(CAMERAS)}
# The other inverse is 0.01 px off
ONE_EACH["ocam"] = next(case.make for case in CAMERAS if case.name == "ocam exact")
KINDS = ("cassini", "pinhole", "equirectangular")
POSES = torch.stack(
    [
        transform_from_axis_angle(torch.tensor(turn).double(), torch.tensor(place).double())
        for turn, place in (([0.1, -0.2, 0.3], [0.0, 0.0, 0.0]), ([-0.05, 0.2, -0.1], [0.3, 0.05, -0.04]))
    ]
)


def two(first: str, second: str) -> CameraRig:
    cameras = [ONE_EACH[first](1.0).to(torch.float64), ONE_EACH[second](1.02).to(torch.float64)]
    return CameraRig(cameras, POSES)


def rows_off(pair: RectifiedPair, content: list[Tensor]) -> Tensor:
    """By how many pixels directions in the world (h, w, 3) lie across the epipolar lines of their pixels (2, h, w)."""
    places = torch.meshgrid(*(torch.arange(n).double() for n in pair.image_size), indexing="ij")
    own, size = (
        (places[0], pair.image_size[0]) if pair.epipolar_dim == -1 else (places[1], pair.image_size[1])
    )
    result = []
    for side, (directions, place) in enumerate(zip(content, pair.rig.positions, strict=True)):
        pixels = (
            pair.project((place + 10 * directions).reshape(-1, 3)).pixels[side].view(*directions.shape[:2], 2)
        )
        off = (pixels[..., 1 if pair.epipolar_dim == -1 else 0] - own).abs()
        around = (
            2 * math.pi / (pair.camera.longitudes[1] - pair.camera.longitudes[0]) * size
            if pair.kind != "pinhole"
            else math.inf
        )
        result.append(torch.minimum(off, (around - off).abs()))
    return torch.stack(result)


def directions_of_source_pixels(pair: RectifiedPair) -> tuple[list[Tensor], Tensor]:
    """The directions in the world that rectified images show (h, w, 3), and where that is told (2, h, w).

    What is rectified are images of pixels' own places, for which bilinear interpolation is exact but across a seam.
    """
    cameras = pair.source.cameras
    images = pair.rectify([camera.pixel_grid(torch.float64).movedim(-1, 0) for camera in cameras.values()])
    directions, inner = [], []
    for image, camera, pose in zip(images, cameras.values(), pair.source.world_from_camera, strict=True):
        pixels, (height, width) = image.movedim(0, -1), camera.image_size
        directions.append(camera.unproject(pixels).directions @ pose[:3, :3].T)
        expected = camera.project(pair.to_directions() @ pose[:3, :3]).pixels
        inner.append(((expected > 0) & (expected < torch.tensor([width - 1, height - 1]))).all(-1))
    return directions, torch.stack(inner) & pair.seen


@pytest.mark.parametrize("first", ONE_EACH)
@pytest.mark.parametrize("kind", KINDS)
def test_law_the_same_rows(first: str, kind: str) -> None:
    assert len(ONE_EACH) == 14
    others = list(ONE_EACH)[list(ONE_EACH).index(first) :]
    for second in others if kind == "cassini" else others[:2]:
        pair = rectified_pairs(two(first, second), kind, [("cam1", "cam2")])[0]
        directions, inner = directions_of_source_pixels(pair)
        assert inner.all(0).double().mean() > 0.2, (first, second)
        worst = float(rows_off(pair, directions)[inner].max())
        assert worst <= 0.05, (first, second, worst)


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_rows_through_seam_and_poles(kind: str) -> None:
    """Panoramas that are images of directions: what rectified ones hold is bilinear, near the baseline of many rows."""
    camera = EquirectangularCamera((256, 512)).to(torch.float64)
    pair = rectified_pairs(CameraRig([camera] * 2, POSES), kind)[0]
    rays = camera.unproject(camera.pixel_grid(torch.float64)).directions
    images = pair.rectify([(rays @ pose[:3, :3].T).movedim(-1, 0) for pose in pair.source.world_from_camera])
    assert pair.seen.all()
    if kind != "pinhole":
        assert pair.image_size[0] * pair.image_size[1] == 2 * 256**2
    off = rows_off(pair, [image.movedim(0, -1) for image in images])
    line = (pair.rig.positions[1] - pair.rig.positions[0]) / pair.baseline
    assert (
        off * torch.linalg.cross(pair.to_directions(), line.expand(*pair.image_size, 3)).norm(dim=-1)
    ).max() <= 0.05


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("first", "second"), [("cam1", "cam2"), ("cam1", "cam3")])
def test_a_point_has_one_row_and_its_disparity_is_its_distance(kind: str, first: str, second: str) -> None:
    rig = ring_rig(4, image_size=(64, 64)).to(torch.float64)
    pair = rectified_pairs(rig, kind, [(first, second)])[0]
    points = torch.randn(4000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points = 1.5 * points / points.norm(dim=-1, keepdim=True)
    pixels, valid = pair.project(points)
    both = valid.all(0)
    assert both.sum() > 20
    dim = 0 if pair.epipolar_dim == -1 else 1
    assert (pixels[0] - pixels[1])[both][:, 1 - dim].abs().max() < 1e-9
    gap = (pixels[0] - pixels[1])[both][:, dim]
    assert gap.min() > 0
    for side, name in enumerate(pair.names):
        rays = pair.to_directions(pixels[side][both])
        away = points[both] - pair.rig.positions[side]
        distance = away.norm(dim=-1)
        assert torch.allclose(rays * distance[:, None], away, atol=1e-9)
        ball = _ball(pair, side)
        disparity, known = pair.disparity(ball, name)
        assert known.any()
        back, valid = pair.distance(disparity, name)
        assert (valid & known).sum() > 0.9 * known.sum()
        assert torch.allclose(back[valid & known], ball[valid & known], rtol=1e-9)
        nearest = pixels[side][both].round().long()
        at = disparity[nearest[:, 1].clamp(0, ball.shape[0] - 1), nearest[:, 0].clamp(0, ball.shape[1] - 1)]
        assert (at - gap)[at > 0].abs().median() < 0.2  # a pixel's centre is not the point


def _ball(pair: RectifiedPair, side: int) -> Tensor:
    """Distances to a ball of 1.5 m around the origin."""
    rays, start = pair.to_directions(), pair.rig.positions[side]
    along = rays @ start
    return (along.square() + 2.25 - start.square().sum()).sqrt() - along


def test_infinity_unknown_and_unseen() -> None:
    pair = rectified_pairs(ring_rig(2, image_size=(64, 64)))[0]  # back to back: a ring is seen twice
    far, valid = pair.distance(torch.zeros(pair.image_size))
    assert torch.equal(valid, pair.seen.all(0))
    assert far[valid].isinf().all()
    assert (far[~valid] == 0).all()
    zero, valid = pair.disparity(torch.full(pair.image_size, math.inf))
    assert torch.equal(valid, pair.seen.all(0))
    assert zero.abs().max() == 0
    for unknown in (-1.0, math.nan):
        assert not pair.distance(torch.full(pair.image_size, unknown))[1].any()
        assert not pair.disparity(torch.full(pair.image_size, unknown))[1].any()
    assert not pair.distance(torch.full(pair.image_size, 1e4))[1].any()  # the rays do not meet


@pytest.mark.parametrize("kind", KINDS)
def test_a_rendered_scene_is_found_at_its_disparity(kind: str) -> None:
    scene, rig = make_scene("room", seed=3), ring_rig(4, image_size=(160, 160))
    pair = rectified_pairs(rig, kind, [("cam1", "cam2")])[0]
    left, right = pair.rectify(render_rig(scene, rig, samples_per_pixel=4))
    depth = ray_depth(scene, pair.rig.positions[0], pair.to_directions())
    disparity, valid = pair.disparity(depth)
    dim = pair.epipolar_dim
    place = torch.arange(left.shape[dim]).view(-1, 1) if dim == -2 else torch.arange(left.shape[dim])
    index = (place - disparity).round().long().clamp(0, left.shape[dim] - 1)
    warped = right.gather(dim, index.expand(3, *left.shape[-2:]))
    matched = (warped - left).abs().mean(0)[valid]
    shifted = (right - left).abs().mean(0)[valid]
    assert valid.float().mean() > 0.2
    assert matched.median() < 0.5 * shifted.median()


def test_left_is_where_the_image_stands_upright() -> None:
    camera = FisheyeCamera.from_field_of_view((32, 32), math.radians(190))
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[0, 0, 3] = 0.1
    pair = rectified_pairs(CameraRig({"right": camera, "left": camera}, poses))[0]
    assert pair.names == ("left", "right")
    assert pair.to_directions()[0, :, 1].max() < 0 < pair.to_directions()[-1, :, 1].min()  # up and down
    poses[0, :3, 3] = torch.tensor([0.0, -0.2, 0.0])
    rig = CameraRig({"top": camera, "bottom": camera}, poses)
    pair = rectified_pairs(rig, "equirectangular")[0]
    assert pair.names == ("top", "bottom")
    assert pair.epipolar_dim == -2
    assert pair.to_directions()[0, :, 1].max() < 0 < pair.to_directions()[-1, :, 1].min()
    assert rectified_pairs(rig, "equirectangular", image_size=(48, 80))[0].image_size == (48, 80)
    assert rectified_pairs(rig, "cassini", image_size=(48, 80))[0].image_size == (48, 80)


def test_gradients_reach_images_disparity_and_poses() -> None:
    rig = ring_rig(4, image_size=(24, 24)).to(torch.float64)
    poses = rig.world_from_camera.clone().requires_grad_()
    pair = rectified_pairs(rig.replaced(world_from_camera=poses), pairs=[("cam1", "cam2")])[0]
    image = torch.rand(2, 3, 24, 24, dtype=torch.float64, requires_grad=True)
    left, right = pair.rectify([image, image])
    disparity = torch.full((2, *pair.image_size), 2.0, dtype=torch.float64, requires_grad=True)
    (left.square().sum() + right.square().sum() + pair.distance(disparity)[0].sum()).backward()
    for tensor in (image, disparity, poses):
        assert tensor.grad is not None
        assert tensor.grad.isfinite().all()
        assert tensor.grad.abs().sum() > 0


def test_batches_and_masks() -> None:
    rig = ring_rig(4, image_size=(32, 32))
    usable = torch.ones(32, 32, dtype=torch.bool)
    usable[20:] = False
    masked = CameraRig(rig.cameras, rig.world_from_camera, {"cam1": usable})
    names = [("cam1", "cam2")]
    whole, partly = (rectified_pairs(r, pairs=names, image_size=(40, 40))[0] for r in (rig, masked))
    fitted = [rectified_pairs(r, pairs=names)[0].image_size for r in (masked, rig)]
    assert math.prod(fitted[0]) < 0.8 * math.prod(fitted[1])  # no larger than what both see
    assert partly.seen[partly.names.index("cam1")].sum() < whole.seen[whole.names.index("cam1")].sum()
    images = {name: torch.rand(5, 3, 32, 32) for name in rig.names}
    left, right = whole.rectify(images)
    assert left.shape == right.shape == (5, 3, *whole.image_size)
    alone = whole.rectify({name: image[2] for name, image in images.items()})
    assert torch.equal(torch.stack(alone), torch.stack((left[2], right[2])))


@pytest.mark.parametrize("kind", ["cassini", "pinhole"])
def test_half_precision_is_computed_in_float32(kind: str) -> None:
    (pair,) = rectified_pairs(ring_rig(4, image_size=(320, 320)), kind, [("cam1", "cam2")])
    disparity = torch.full(pair.image_size, 10.0)
    for expected, found in zip(pair.distance(disparity), pair.distance(disparity.bfloat16()), strict=True):
        torch.testing.assert_close(found, expected)


def test_virtual_cameras_stand_where_the_real_ones_do_in_a_far_world() -> None:
    rig = ring_rig(4, image_size=(32, 32)).replaced(origin=torch.tensor([4e5, 0.0, 5e6]).double())
    (pair,) = rectified_pairs(rig, pairs=[("cam1", "cam2")])
    torch.testing.assert_close(pair.rig.in_world().positions, pair.source.in_world().positions)
