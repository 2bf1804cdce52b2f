# SPDX-License-Identifier: Apache-2.0
"""Rigs: poses, order, tilts, batches and images looked up in the world."""

from __future__ import annotations

import math

import pytest
import torch

from sphericalvision.cameras import CameraRig, FisheyeCamera, ring_rig, sample_sphere
from sphericalvision.geometry import transform_from_axis_angle

UP, DOWN, FORWARD, RIGHT = (torch.tensor(d) for d in ([0.0, -1, 0], [0.0, 1, 0], [0.0, 0, 1], [1.0, 0, 0]))


def small_ring(**kwargs: object) -> CameraRig:
    return ring_rig(4, image_size=(64, 64), **kwargs)


def unit_vectors(count: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    """The same each time, in all directions."""
    values = torch.randn(count, 3, generator=torch.Generator().manual_seed(3), dtype=dtype)
    return torch.nn.functional.normalize(values, dim=-1)


def test_ring_faces_front_right_back_left_from_its_circle() -> None:
    rig = small_ring(radius=0.3)
    expected = torch.stack((FORWARD, RIGHT, -FORWARD, -RIGHT))
    torch.testing.assert_close(rig.axes, expected)
    torch.testing.assert_close(rig.world_from_camera[:, :3, 3], 0.3 * expected)
    torch.testing.assert_close(rig.world_from_camera[:, :3, 1], DOWN.expand(4, 3))  # every image is upright
    torch.testing.assert_close(rig.center, torch.zeros(3))
    torch.testing.assert_close(rig.max_angles, torch.full((4,), math.radians(110)))


def test_radius_is_the_mean_distance_from_the_mean_position() -> None:
    poses = torch.eye(4).repeat(4, 1, 1)
    poses[:, :3, 3] = torch.tensor([[4.0, 0, 0], [0.0, 0, 0], [0.0, 0, 0], [0.0, 0, 0]])
    rig = CameraRig(small_ring().cameras, poses)
    assert rig.center.tolist() == [1, 0, 0]
    assert rig.radius.item() == pytest.approx((3 + 1 + 1 + 1) / 4)


def test_the_centre_may_be_that_of_some_cameras_and_goes_with_them() -> None:
    ring = ring_rig(4, radius=0.2, image_size=(16, 16))
    rig = CameraRig(ring.cameras, ring.world_from_camera, around=["cam1", "cam2"])
    torch.testing.assert_close(rig.center, torch.tensor([0.1, 0, 0.1]))
    half_turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0]))
    changed = {
        "double": rig.to(torch.float64),
        "turned": rig.rotated(rotation=half_turn),
        "resized": rig.resized((8, 8)),
        "scaled": rig.scaled(2.0),
        "batch": CameraRig.stack([rig, rig]),
        "one": CameraRig.stack([rig, rig]).select(1),
        "order": rig.permuted([3, 2, 1, 0]),
        "subset": rig.subset(["cam4", "cam2"]),
        "others": rig.subset(["cam3", "cam4"]),
    }
    factors = {name: changed[name].center.float() / 0.1 for name in changed}
    wanted = {
        **{name: torch.tensor([1.0, 0.0, 1.0]) for name in ("double", "resized", "one", "order")},
        "turned": torch.tensor([-1.0, 0, -1]),
        "scaled": torch.tensor([2.0, 0, 2]),
        "batch": torch.tensor([[1.0, 0, 1]] * 2),
        "subset": torch.tensor([2.0, 0, 0]),
        "others": torch.tensor([-1.0, 0, -1]),
    }
    torch.testing.assert_close(factors, wanted, check_dtype=False)


def test_tilt_looks_down_by_the_angle_and_moves_nothing() -> None:
    rig = small_ring()
    tilt = math.radians(30)
    tilted = rig.rotated(tilt=tilt)
    torch.testing.assert_close(tilted.axes, math.cos(tilt) * rig.axes + math.sin(tilt) * DOWN)
    torch.testing.assert_close(tilted.world_from_camera[:, :3, 3], rig.world_from_camera[:, :3, 3])
    # Its own x axis
    torch.testing.assert_close(tilted.world_from_camera[:, :3, 0], rig.world_from_camera[:, :3, 0])
    back = tilted.rotated(tilt=torch.full((4,), -tilt))
    torch.testing.assert_close(back.world_from_camera, rig.world_from_camera)


def test_rotation_turns_the_whole_rig() -> None:
    rig = small_ring()
    quarter = transform_from_axis_angle(torch.tensor([0.0, math.pi / 2, 0.0]), torch.zeros(3))[:3, :3]
    turned = rig.rotated(rotation=quarter)
    torch.testing.assert_close(turned.world_from_camera, rig.permuted([1, 2, 3, 0]).world_from_camera)


def test_subset_and_permutation_keep_names_poses_and_masks_together() -> None:
    rig = small_ring()
    mask = torch.ones(64, 64, dtype=torch.bool)
    rig = CameraRig(rig.cameras, rig.world_from_camera, {"cam3": mask})
    chosen = rig.subset(["cam3", 1])
    assert chosen.names == ["cam3", "cam2"]
    assert list(chosen.masks) == ["cam3"]
    torch.testing.assert_close(chosen.axes, torch.stack((-FORWARD, RIGHT)))


def test_stack_shares_what_is_equal_and_select_undoes_it() -> None:
    first = small_ring()
    wider = FisheyeCamera.from_field_of_view((64, 64), math.radians(230))
    second = CameraRig({**first.cameras, "cam2": wider}, first.rotated(tilt=0.2).world_from_camera)
    batch = CameraRig.stack([first, second])
    assert batch.world_from_camera.shape == (2, 4, 4, 4)
    assert batch.cameras["cam1"].batch_shape == ()
    assert batch.cameras["cam2"].batch_shape == (2,)
    assert batch.center.shape == (2, 3)
    assert batch.axes.shape == (2, 4, 3)
    torch.testing.assert_close(batch.max_angles[:, 1], torch.tensor([110.0, 115.0]).deg2rad())
    for index, rig in enumerate((first, second)):
        again = batch.select(index)
        torch.testing.assert_close(again.world_from_camera, rig.world_from_camera)
        assert all(again.cameras[name].equals(camera) for name, camera in rig.cameras.items())


def test_stack_keeps_different_masks_apart() -> None:
    rig = small_ring()
    mask = torch.zeros(64, 64, dtype=torch.bool)
    batch = CameraRig.stack([rig, CameraRig(rig.cameras, rig.world_from_camera, {"cam1": mask})])
    images = [torch.ones(2, 1, 64, 64)] * 4
    _, valid = sample_sphere(batch, images, FORWARD[None])
    assert valid[:, 0, 0].tolist() == [True, False]
    for index, usable in enumerate((True, False)):
        assert torch.equal(batch.select(index).masks["cam1"], torch.full((64, 64), usable))
    shared = CameraRig(rig.cameras, batch.world_from_camera, {"cam1": mask})  # one mask for both rigs
    assert torch.equal(shared.select(1).masks["cam1"], mask)


def panorama(directions: torch.Tensor) -> torch.Tensor:
    """A smooth picture of the world at infinity, (*, 3) -> (*, 3)."""
    return 0.5 + 0.3 * torch.sin(2 * directions + directions.roll(1, -1))


def test_sample_sphere_shows_the_world_upright_whatever_the_pose() -> None:
    """Each camera photographs the same distant world: in world directions all agree with it and with each other."""
    directions = unit_vectors(500, torch.float32)
    rig = ring_rig(4, image_size=(300, 320)).rotated(tilt=0.3)
    images = {}
    for (name, camera), pose in zip(rig.cameras.items(), rig.world_from_camera, strict=True):
        seen = camera.unproject(camera.pixel_grid()).directions
        images[name] = panorama(seen @ pose[:3, :3].T).movedim(-1, 0)
    values, valid = sample_sphere(rig, images, directions)
    assert values.shape == (4, 3, 500)
    expected = panorama(directions).T.expand(4, 3, 500)
    error = (values - expected).abs().amax(1)
    assert error[valid].max() < 1e-3
    assert (values.movedim(1, -1)[~valid] == 0.5).all()
    angle = torch.arccos((directions @ rig.axes.T).clamp(-1, 1)).T
    assert torch.equal(valid, angle <= math.radians(110))
    assert torch.equal(sample_sphere(rig, list(images.values()), directions)[0], values)


def test_sample_sphere_of_a_batch_equals_the_loop(generator: torch.Generator) -> None:
    rigs = [small_ring(), small_ring().rotated(tilt=0.4)]
    directions = unit_vectors(50, torch.float32)
    images = torch.rand(4, 2, 3, 64, 64, generator=generator)
    values, valid = sample_sphere(CameraRig.stack(rigs), list(images), directions)
    assert values.shape == (2, 4, 3, 50)
    for index, rig in enumerate(rigs):
        alone, seen = sample_sphere(rig, list(images[:, index]), directions)
        torch.testing.assert_close(values[index], alone)
        assert torch.equal(valid[index], seen)


def test_antialias_averages_what_the_directions_cannot_show() -> None:
    """A checkerboard of single pixels is grey from far away; without averaging it is black and white."""
    rig = ring_rig(4, image_size=(800, 800))
    v, u = torch.meshgrid(torch.arange(800), torch.arange(800), indexing="ij")
    board = ((u + v) % 2).float()[None]
    directions = unit_vectors(2000, torch.float32)
    plain, valid = sample_sphere(rig, [board] * 4, directions)
    smooth, same = sample_sphere(rig, [board] * 4, directions, antialias=True)
    assert torch.equal(valid, same)
    assert plain[:, 0][valid].std() > 0.1
    assert smooth[:, 0][valid].std() < 0.02
    assert smooth[:, 0][valid].mean().item() == pytest.approx(0.5, abs=0.01)


def test_masked_pixels_are_filled() -> None:
    rig = small_ring()
    mask = torch.ones(64, 64, dtype=torch.bool)
    mask[:, 32:] = False  # the right half of the front camera
    rig = CameraRig(rig.cameras, rig.world_from_camera, {"cam1": mask})
    sides = torch.tensor([[-0.5, 0.0, 1.0], [0.5, 0.0, 1.0]])
    values, valid = sample_sphere(rig, [torch.ones(1, 64, 64)] * 4, sides, fill=0.25)
    assert valid[0].tolist() == [True, False]
    torch.testing.assert_close(values[0, 0], torch.tensor([1.0, 0.25]))


def test_to_moves_everything() -> None:
    rig = small_ring().to(torch.float64)
    assert rig.world_from_camera.dtype == torch.float64
    assert rig.cameras["cam1"].dtype == torch.float64
    assert rig.to("cpu").center.dtype == torch.float64


def masked_ring(*tilts: float) -> CameraRig:
    """Three fisheyes, the second with a mask; one rig for each tilt, stacked if there are several."""
    rig = ring_rig(3, radius=0.3, image_size=(64, 80))
    mask = torch.ones(64, 80, dtype=torch.bool)
    mask[:, :30] = mask[45:, :] = False
    rig = CameraRig(rig.cameras, rig.world_from_camera, {"cam2": mask}).to(torch.float64)
    return CameraRig.stack([rig.rotated(tilt=tilt) for tilt in tilts]) if len(tilts) > 1 else rig


def seen_by_hand(rig: CameraRig, name: str, local: torch.Tensor) -> tuple[torch.Tensor, bool]:
    """The pixel of a point in a camera's frame, and whether it is seen: on the mask by the four pixels around it."""
    pixel, seen = rig.cameras[name].project(local)
    if not seen or name not in rig.masks:
        return pixel, bool(seen)
    height, width = rig.cameras[name].image_size
    u, v = pixel.tolist()
    rows = {min(max(place, 0), height - 1) for place in (math.floor(v), math.ceil(v))}
    columns = {min(max(place, 0), width - 1) for place in (math.floor(u), math.ceil(u))}
    return pixel, all(bool(rig.masks[name][i, j]) for i in rows for j in columns)


def test_project_asks_each_camera_for_each_point_by_hand(generator: torch.Generator) -> None:
    rig = masked_ring()
    points = torch.randn(150, 3, generator=generator, dtype=torch.float64)
    pixels, valid = rig.project(points)
    assert pixels.shape == (3, 150, 2)
    assert valid.shape == (3, 150)
    for index, (name, pose) in enumerate(zip(rig.names, rig.world_from_camera, strict=True)):
        for number, point in enumerate(points):
            pixel, seen = seen_by_hand(rig, name, pose[:3, :3].T @ (point - pose[:3, 3]))
            torch.testing.assert_close(pixels[index, number], pixel)
            assert bool(valid[index, number]) == seen
    unmasked = CameraRig(rig.cameras, rig.world_from_camera).project(points).valid
    assert (unmasked & ~valid)[1].sum() > 10, "the mask hides a part of what the second camera sees"
    assert torch.equal(unmasked[[0, 2]], valid[[0, 2]])


def test_points_seen_asks_each_camera_for_each_point_by_hand() -> None:
    rig = masked_ring()
    directions = unit_vectors(60)
    inverse_depths = torch.tensor([0.0, 0.5, 2.0], dtype=torch.float64)
    seen = rig.points_seen(directions, inverse_depths)
    assert seen.shape == (3, 3, 60)
    for index, (name, pose) in enumerate(zip(rig.names, rig.world_from_camera, strict=True)):
        for number, inverse_depth in enumerate(inverse_depths.tolist()):
            for place, direction in enumerate(directions):
                ray = (
                    direction if inverse_depth == 0 else rig.center + direction / inverse_depth - pose[:3, 3]
                )
                expected = seen_by_hand(rig, name, pose[:3, :3].T @ ray)[1]
                assert bool(seen[index, number, place]) == expected, (name, inverse_depth, direction)


def test_project_along_is_exact_far_away_and_equals_project_near_by() -> None:
    rig = masked_ring()
    directions = unit_vectors(40)
    pixels, valid = rig.project_along(directions, torch.tensor([0.0, 0.8]))
    near = rig.project(rig.center + directions / 0.8).pixels
    torch.testing.assert_close(pixels[:, 1], near, rtol=1e-6, atol=1e-6)
    for index, camera in enumerate(rig.cameras.values()):
        turned = directions @ rig.world_from_camera[index, :3, :3]
        assert torch.equal(pixels[index, 0], camera.project(turned).pixels)
    own = torch.tensor([0.0, 0.8]).double()[:, None].expand(2, 40)
    assert torch.equal(rig.project_along(directions, own).valid, valid)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_points_in_half_precision_are_projected_in_float32(
    dtype: torch.dtype, generator: torch.Generator
) -> None:
    rig = ring_rig(5, radius=0.23).rotated(tilt=0.37)
    points = torch.randn(50, 3, generator=generator).to(dtype)
    near = torch.tensor([0.0, 0.5], dtype=dtype)
    for found, expected in (
        (rig.project(points), rig.project(points.float())),
        (rig.project_along(points, near), rig.project_along(points.float(), near.float())),
    ):
        assert found.pixels.dtype == torch.float32
        assert torch.equal(found.pixels, expected.pixels)
        assert torch.equal(found.valid, expected.valid)


def test_rigs_of_a_batch_project_as_their_members(generator: torch.Generator) -> None:
    batch = masked_ring(0.0, 0.4)
    points = torch.randn(2, 30, 3, generator=generator, dtype=torch.float64)
    directions = torch.nn.functional.normalize(points[0], dim=-1)
    together, apart = batch.project(points), batch.project(points[0])
    seen = batch.points_seen(directions, torch.tensor([0.0, 1.0, 3.0]))
    assert together.pixels.shape == (2, 3, 30, 2)
    assert seen.shape == (2, 3, 3, 30)
    for index in range(2):
        rig = batch.select(index)
        torch.testing.assert_close(together.pixels[index], rig.project(points[index]).pixels)
        assert torch.equal(together.valid[index], rig.project(points[index]).valid)
        torch.testing.assert_close(apart.pixels[index], rig.project(points[0]).pixels)
        assert torch.equal(seen[index], rig.points_seen(directions, torch.tensor([0.0, 1.0, 3.0])))


def test_gradients_reach_poses_and_points() -> None:
    poses = masked_ring().world_from_camera.requires_grad_()
    rig = CameraRig(masked_ring().cameras, poses)
    points = torch.tensor([[0.3, 0.2, 2.0]], dtype=torch.float64, requires_grad=True)
    torch.autograd.grad(rig.project(points).pixels.sum(), (poses, points))
    rig.project_along(points.detach(), torch.ones(1)).pixels.sum().backward()
    assert poses.grad is not None
    assert poses.grad[:, :3, 3].abs().sum() > 1
