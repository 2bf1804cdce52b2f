# SPDX-License-Identifier: Apache-2.0
"""Views of a panorama or a rig, functions of them, and the way back."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import (
    Camera,
    CameraRig,
    EquirectangularCamera,
    FisheyeCamera,
    PinholeCamera,
    RectifiedPair,
    rectified_pairs,
    remap,
    ring_rig,
    rotation_from_yaw_pitch_roll,
    z_from_depth,
)
from sphericalvision.core import ShapeError
from sphericalvision.icosphere import Icosphere
from sphericalvision.scenes import make_scene, ray_depth
from sphericalvision.sphere import Equirectangular, Views, views
from sphericalvision.sphere.resampling.merge import pixel_weights, robust_mean

DOUBLE = torch.float64
PANORAMA = EquirectangularCamera((48, 96))
LAYOUTS = pytest.mark.parametrize("layout", ["cube", "tangent", [(0.4, 0.3, 1.0), (3.0, 0.0, 0.0)]])


def smooth(directions: Tensor) -> Tensor:
    """Three channels (3, ...) of a function of directions without structure below a tenth of a radian."""
    return torch.stack(
        ((2 * directions[..., 0]).sin(), directions[..., 1] * directions[..., 2], directions.sum(-1))
    )


def pixels(camera: Camera) -> Tensor:
    return camera.unproject(camera.pixel_grid()).directions


@LAYOUTS
def test_constants_stay_constant(layout: str) -> None:
    cut = views(torch.full((2, 1, 48, 96), 3.5), layout=layout, image_size=(40, 40))
    for quantity in ("values", "range"):
        values, valid, spread = cut.merge(quantity=quantity)
        assert values.shape == (2, 1, 48, 96)
        assert valid.shape == spread.shape == (2, 48, 96)
        assert valid.all() or not isinstance(layout, str)
        torch.testing.assert_close(values, torch.where(valid, 3.5, 0.0)[:, None], atol=1e-5, rtol=0)
        assert spread.max() < 1e-5
    ico = cut.merge(Icosphere(3))
    torch.testing.assert_close(ico.values[ico.valid[:, None]], torch.tensor(3.5).expand(int(ico.valid.sum())))


@pytest.mark.parametrize("layout", ["cube", "tangent"])
def test_there_and_back_is_the_panorama_within_interpolation(layout: str) -> None:
    """The error falls with the square of the pixels, and is no more than thrice that of one interpolation each way."""
    errors = []
    for height in (24, 48):
        camera = EquirectangularCamera((height, 2 * height)).to(DOUBLE)
        panorama = smooth(pixels(camera))
        back = views(panorama, camera, layout).merge()
        assert back.valid.all()
        errors.append((back.values - panorama).abs().max().item())
    assert errors[1] < 0.35 * errors[0]
    assert errors[1] < 3 * 2 * (2 * math.pi / 96) ** 2 / 8 * 4  # second derivatives are 4 at most


def test_any_function_of_images_is_mapped() -> None:
    """Of another size or without channels, in parts; what is no image is refused."""
    cut = views(smooth(pixels(PANORAMA)).expand(2, -1, -1, -1), image_size=(40, 40))
    asked: list[int] = []

    def half(images: Tensor) -> Tensor:
        asked.append(len(images))
        return torch.nn.functional.avg_pool2d(images, 2).sum(1)

    merged = cut.map(half, batch=5).merge()
    assert asked == [5, 5, 2]
    assert merged.values.shape == (2, 1, 48, 96)
    expected = smooth(pixels(PANORAMA)).sum(0)
    torch.testing.assert_close(merged.values[1, 0], expected, atol=0.03, rtol=0)
    for wrong in (lambda x: x[:1], lambda x: x.flatten(1)):
        with pytest.raises(ShapeError, match="function: expected"):
            cut.map(wrong)


@pytest.mark.parametrize(("layout", "quantity"), [("cube", "z"), ("tangent", "range")])
def test_depth_of_a_rendered_room_is_merged_to_the_truth(layout: str, quantity: str) -> None:
    """Each view with a scale of its own: they agree again, and the geometric mean of all scales is kept."""
    scene, origin = make_scene("room", 4), torch.zeros(3)
    truth = ray_depth(scene, origin, pixels(PANORAMA))
    cut = views(torch.zeros(1, 48, 96), layout=layout, image_size=(64, 64))
    scales = torch.rand(len(cut.rig), generator=torch.Generator().manual_seed(0)) + 0.5
    images = []
    for scale, (name, lens) in zip(scales, cut.rig.cameras.items(), strict=True):
        turn = cut.rig.world_from_camera[cut.rig.names.index(name), :3, :3]
        depth = ray_depth(scene, origin, pixels(lens) @ turn.T)
        images.append(scale * (z_from_depth(depth, lens)[0] if quantity == "z" else depth)[None])
    estimated = Views(images, cut.rig, cut.target)
    found = estimated.merge(quantity=quantity)
    error = (found.values[0] / scales.log().mean().exp() / truth - 1).abs()
    assert found.valid.all()
    assert error.median() < 2e-3
    assert error.quantile(0.95) < 0.03, "but for what is at edges of things"
    apart = (estimated.merge(quantity=quantity, align=False).values[0] / truth).log()
    assert apart.std() > 0.1
    images[0][..., 10:20, 10:20] = 0.0  # which is unknown, and asked of the others
    images[0][..., 30:40, 10:20] = torch.inf
    holed = Views(images, cut.rig, cut.target).merge(quantity=quantity)
    torch.testing.assert_close(
        holed.values[holed.valid[None]], found.values[holed.valid[None]], rtol=0.1, atol=0
    )


def test_a_view_that_disagrees_counts_little() -> None:
    """Where three or more views overlap, of which one sees something else; and the spread tells."""
    panorama = smooth(pixels(PANORAMA))
    cut = views(panorama, layout="tangent", field_of_view=math.radians(110), image_size=(40, 40))
    plain = cut.merge()
    cut.images[3] = cut.images[3] + 1
    off = cut.merge()
    seen = Views(
        [torch.ones(1, 40, 40)],
        CameraRig([cut.rig.cameras["cam4"]], cut.rig.world_from_camera[3:4]),
        PANORAMA,
    )
    there = seen.merge().valid
    assert (off.values - plain.values)[:, there].abs().mean() < 0.1
    assert off.spread[there].mean() > 2 * plain.spread[there].mean()


@pytest.mark.parametrize(
    "camera",
    [FisheyeCamera.from_field_of_view((64, 96), 3.5), PinholeCamera([40.0] * 2, [47.5, 31.5], (64, 96))],
)
def test_no_seam_shows_where_a_view_ends(camera: Camera) -> None:
    """Pixels count the less, the nearer they are to the end of the field of view or of the image."""
    seen = camera.unproject(camera.pixel_grid()).valid
    for weights in (pixel_weights(camera)[32][seen[32]], pixel_weights(camera)[:, 48][seen[:, 48]]):
        assert (weights.diff()[: len(weights) // 2 - 1] > 0).all()
        assert (weights.diff()[len(weights) // 2 + 1 :] < 0).all()
        assert weights[[0, -1]].max() < 0.05 * weights.max()


def test_pixels_count_by_their_solid_angle_and_their_distance_from_the_border() -> None:
    camera = PinholeCamera([40.0, 50.0], [47.5, 31.5], (64, 96)).to(DOUBLE)
    u, v = (camera.pixel_grid() - camera.principal_point).abs().unbind(-1)
    slope = (u / 40).hypot(v / 50)
    border = torch.stack((1 - u / 48, 1 - v / 32, 1 - slope.atan() / camera.max_angle)).amin(0)
    expected = (1 + slope.square()) ** -1.5 * border
    torch.testing.assert_close(pixel_weights(camera), expected, atol=3e-3, rtol=0)


def test_places_of_one_view_change_nothing_of_those_of_several(generator: torch.Generator) -> None:
    values, weights = (torch.rand(4, c, 250, generator=generator) for c in (2, 1))
    weights[1:, :, 50:] = 0
    mean, spread = robust_mean(values, weights, 1)
    overlap, its_spread = robust_mean(values[..., :50], weights[..., :50], 1)
    torch.testing.assert_close(mean[..., :50], overlap)
    torch.testing.assert_close(spread[..., :50], its_spread)
    torch.testing.assert_close(mean[..., 50:], values[0, :, 50:])
    # By hand: weights of 1 / (1 + r² / s²), twice.
    mean, spread = robust_mean(*torch.tensor([[0.0, 1.0, 4.0], [2.0, 1.0, 1.0]])[..., None, None], 1)
    assert (mean.item(), spread.item()) == pytest.approx((0.5884906, 0.9281288))


def test_photographs_of_a_rig_merge_into_the_panorama_that_they_show() -> None:
    """Two fisheyes back to back and a pinhole; and perspective views are cut from all of them together."""
    panorama = smooth(pixels(PANORAMA))
    fisheye = FisheyeCamera.from_field_of_view((60, 64), math.radians(200))
    cameras = {"front": fisheye, "back": fisheye, "detail": PinholeCamera.from_field_of_view((40, 50), 1.0)}
    poses = torch.eye(4).repeat(3, 1, 1)
    poses[1, 0, 0] = poses[1, 2, 2] = -1
    rig = CameraRig(cameras, poses, {"front": torch.arange(64).expand(60, 64) > 1})
    images = {
        name: remap(panorama, PANORAMA, lens, poses[k, :3, :3].T)
        for k, (name, lens) in enumerate(cameras.items())
    }
    whole = Views(images, rig).merge(PANORAMA)
    assert whole.valid.all()
    torch.testing.assert_close(whole.values, panorama, atol=0.02, rtol=0)
    cut = views(images, rig, [(1.5, 0.2, 0.1)], 1.0, (30, 30))
    direct = views(panorama, None, [(1.5, 0.2, 0.1)], 1.0, (30, 30))
    torch.testing.assert_close(cut.images[0], direct.images[0], atol=0.02, rtol=0)
    assert repr(Views(images, rig).target) == repr(cut.target)
    alone = views(images["front"], fisheye, "cube", image_size=(20, 20))
    assert set(alone.rig.masks) == {"cam2", "cam3", "cam4", "cam5", "cam6"}  # all but the view ahead
    steps = {"front": images["front"].round()}  # of which the nearest pixel has one
    front = CameraRig({"front": fisheye}, poses[:1])
    for mode, whole_steps in (("nearest", True), ("bilinear", False)):
        shown = views(steps, front, [(0.0, 0.0, 0.0)], 1.0, (30, 30), mode=mode).images[0]
        assert torch.equal(shown, shown.round()) == whole_steps


def test_views_look_where_they_are_told() -> None:
    """A panorama of directions: each view's middle shows its own, and the axes are right, down and forward."""
    source = EquirectangularCamera((180, 360))
    panorama = pixels(source).movedim(-1, 0)
    angles = [(0.0, 0.0, 0.0), (math.pi / 2, 0.0, 0.0), (0.3, -0.4, 0.0), (0.3, -0.4, math.pi / 2)]
    images = views(panorama, None, angles, 1.0, (41, 41)).images
    for view, (yaw, pitch, _) in zip(images, angles, strict=True):
        expected = [math.sin(yaw) * math.cos(pitch), -math.sin(pitch), math.cos(yaw) * math.cos(pitch)]
        torch.testing.assert_close(view[:, 20, 20], torch.tensor(expected), atol=1e-3, rtol=0)
    upright, rolled = images[2], images[3]  # clockwise from behind: what was right is now up
    torch.testing.assert_close(rolled[:, 20, 40], upright[:, 40, 20], atol=2e-3, rtol=0)
    assert (images[0][1, -1, 20] > 0) & (images[0][0, 20, -1] > 0)
    batch = views(panorama.expand(2, -1, -1, -1), None, angles, 1.0, (41, 41)).images
    torch.testing.assert_close(batch[3][1], rolled)
    lens = PinholeCamera.from_field_of_view((41, 41), 1.0)
    torch.testing.assert_close(images[0], remap(panorama, source, lens))
    wide = views(panorama, None, angles, (1.2, 0.8), (41, 61)).images[0]
    across, down = (torch.atan2(wide[axis], wide[2]) for axis in (0, 1))
    assert across[20, -1].item() == pytest.approx(math.atan(60 / 61 * math.tan(0.6)), abs=2e-3)
    assert down[-1, 30].item() == pytest.approx(math.atan(40 / 41 * math.tan(0.4)), abs=2e-3)


def test_parts_of_panoramas_and_grids_are_cut_too() -> None:
    part = Equirectangular(24, 60, latitudes=(-0.6, 0.9), longitudes=(-1.5, 1.6))
    values = smooth(part.directions)
    back = views(values, part, "tangent").merge()
    inside = back.valid
    assert inside.double().mean() > 0.9
    torch.testing.assert_close(back.values[:, inside], values[:, inside], atol=0.03, rtol=0)
    outside = views(values, part, "tangent").merge(PANORAMA).valid
    assert 0.2 < outside.double().mean() < 0.3


@pytest.mark.parametrize("quantity", ["values", "range"])
def test_gradients_go_through_views(quantity: str) -> None:
    """Merging twice the values gives twice the result: by Euler, so say the derivatives, of pixels and parameters."""
    camera = EquirectangularCamera((12, 24)).to(DOUBLE)
    panorama = (smooth(pixels(camera))[:1] + 3).requires_grad_()
    factor = torch.tensor(1.5, dtype=DOUBLE, requires_grad=True)
    merged = (
        views(panorama, camera, image_size=(9, 9)).map(lambda x: factor * x).merge(quantity=quantity).values
    )
    weights = torch.rand(12, 24, dtype=DOUBLE)
    by_pixel, by_factor = torch.autograd.grad((weights * merged).sum(), (panorama, factor))
    torch.testing.assert_close((by_pixel * panorama).sum(), (weights * merged).sum())
    torch.testing.assert_close(by_factor * factor, (weights * merged).sum())
    assert (by_pixel != 0).double().mean() > 0.5  # at a pole some are not read


def test_the_target_of_a_rig_is_a_panorama_as_fine_as_its_finest_camera() -> None:
    detail = PinholeCamera([30.0, 40.0], [29.5, 23.5], (48, 60))
    rig = CameraRig([FisheyeCamera.from_field_of_view((64, 64), 3.5), detail], torch.eye(4).expand(2, 4, 4))
    target = Views([torch.zeros(1, 64, 64), torch.zeros(1, 48, 60)], rig).target
    assert isinstance(target, Camera)
    assert target.image_size == (126, 252)  # 40 pixels a radian


def test_views_are_as_fine_as_the_panorama_in_their_middle() -> None:
    cut = views(torch.rand(3, 48, 96), None, [(0.4, 0.3, 1.0)], (1.2, 0.7))
    sizes = [math.ceil(2 * math.tan(angle / 2) * 48 / math.pi) for angle in (0.7, 1.2)]
    assert [*cut.images[0].shape[-2:]] == sizes


def room_of_pairs() -> tuple[CameraRig, list[RectifiedPair], list[Tensor], Callable[[Tensor], Tensor]]:
    """A rig in a room, its rectified pairs and their true disparities, and the true depth from the rig's centre."""
    rig, scene = ring_rig(4, image_size=(64, 64)), make_scene("room", seed=3)
    pairs = rectified_pairs(rig)
    disparities = []
    for pair in pairs:
        disparity, valid = pair.disparity(ray_depth(scene, pair.rig.positions[0], pair.to_directions()))
        disparities.append(torch.where(valid, disparity, -1.0))
    return rig, pairs, disparities, lambda directions: ray_depth(scene, rig.center, directions)


def test_rectified_pairs_are_merged_around_the_center_of_the_rig() -> None:
    rig, pairs, disparities, truth = room_of_pairs()
    for target in (EquirectangularCamera((24, 48)), Icosphere(3)):
        views_of_pairs = Views.of_pairs(pairs, disparities, target)
        merged = views_of_pairs.merge(quantity="range", align=False, center=rig.center)
        directions = (
            target.vertices
            if isinstance(target, Icosphere)
            else target.unproject(target.pixel_grid()).directions
        )
        true, depth = truth(directions), merged.values[0]
        assert merged.valid.float().mean() > 0.99
        error = (depth / true - 1).abs()[merged.valid]
        assert error.median() < 0.002
        from_one_place = views_of_pairs.merge(quantity="range", align=False)
        assert (from_one_place.values[0] / true - 1).abs().median() > 2 * error.median()  # parallax counts


def test_pairs_of_a_batch_turned_and_unknown() -> None:
    rig, pairs, disparities, _ = room_of_pairs()
    target = EquirectangularCamera((12, 24))
    both = [torch.stack((part, torch.full_like(part, -1.0))) for part in disparities]
    merged = Views.of_pairs(pairs, both, target).merge(quantity="range", align=False, center=rig.center)
    alone = Views.of_pairs(pairs, disparities, target)
    single = alone.merge(quantity="range", align=False, center=rig.center)
    assert torch.allclose(merged.values[0], single.values, rtol=1e-4)
    assert not merged.valid[1].any()
    quarter = rotation_from_yaw_pitch_roll(torch.tensor([math.pi / 2, 0.0, 0.0]))  # world_from_target
    turned = alone.merge(rotation=quarter.mT, quantity="range", align=False, center=rig.center)
    assert (turned.values - single.values.roll(-6, -1)).abs().median() < 1e-3


def test_pairs_that_see_infinity_are_merged_far_away() -> None:
    """A disparity of 0 is no distance that can be averaged: it counts as a thousand baselines."""
    rig, pairs, disparities, _ = room_of_pairs()
    target = EquirectangularCamera((12, 24))
    sky = Views.of_pairs(pairs, [torch.zeros_like(disparity) for disparity in disparities], target)
    merged = sky.merge(quantity="range", align=False, center=rig.center)
    assert merged.valid.float().mean() > 0.99
    baseline = float(pairs[0].baseline)
    far = merged.values[0][merged.valid] / baseline
    assert far.isfinite().all()
    assert far.min() > 500
    assert 900 < far.median() < 1100
