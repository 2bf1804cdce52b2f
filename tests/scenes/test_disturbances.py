# SPDX-License-Identifier: Apache-2.0
"""What real cameras do to a frame, rigs drawn at random, and carriers in view."""

import math
from dataclasses import replace

import pytest
import torch

from sphericalvision.cameras import EquirectangularCamera, FisheyeCamera, ring_rig
from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import Icosphere
from sphericalvision.recipes.app.rigs import make_corner_rig
from sphericalvision.scenes import make_scene, ray_depth, render_rig
from sphericalvision.scenes.carriers import CARRIERS, carrier_masks, with_carrier
from sphericalvision.scenes.disturbances import (
    AMOUNTS,
    DISTURBANCES,
    CameraDisturbance,
    RandomFaults,
    register_disturbance,
    turned_poses,
    vignetted,
)
from sphericalvision.scenes.random_rigs import random_rig
from sphericalvision.scenes.rendering.raycast import trace

RIG = ring_rig(3, image_size=(24, 24))
IMAGES = {name: torch.rand(3, 24, 24, generator=torch.Generator().manual_seed(4)) for name in RIG.names}
FRAME = {"images": IMAGES, "rig": RIG}


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_nothing_given_changes_nothing() -> None:
    same = CameraDisturbance()(FRAME, seeded(0))
    assert all(torch.equal(same["images"][name], IMAGES[name]) for name in RIG.names)
    assert same["rig"] is RIG


ALL = CameraDisturbance(True, 0.5, 0.8, 0.5, 0.1, 0.02, 0.01)


def test_a_seed_says_it_all_and_cameras_differ() -> None:
    one, two, other = (ALL({**FRAME}, seeded(seed)) for seed in (1, 1, 2))
    for name in RIG.names:
        assert torch.equal(one["images"][name], two["images"][name])
        assert not torch.equal(one["images"][name], other["images"][name])
    assert torch.equal(one["rig"].world_from_camera, two["rig"].world_from_camera)
    first, second = (one["images"][name].mean() for name in RIG.names[:2])
    assert abs(first - second) > 1e-3  # the images were the same


def test_grey_has_one_colour_and_keeps_the_range() -> None:
    for image in ALL(FRAME, seeded(3))["images"].values():
        assert 0 <= image.min() <= image.max() <= 1
    grey = CameraDisturbance(grey=True)(FRAME)["images"]["cam1"]
    torch.testing.assert_close(grey[0], grey[2])
    weights = torch.tensor([0.299, 0.587, 0.114])[:, None, None]
    torch.testing.assert_close(grey[0], (IMAGES["cam1"] * weights).sum(0))


def test_exposure_is_a_factor_on_light() -> None:
    """Between half of the stops and all of them, up or down, the same for the three channels."""
    dim = {name: 0.2 + 0.1 * image for name, image in IMAGES.items()}
    out = CameraDisturbance(exposure=1.0)({"images": dim, "rig": RIG}, seeded(5))["images"]
    for name in RIG.names:
        stops = torch.log2((out[name] / dim[name]) ** 2.2)
        assert stops.std() < 1e-4
        assert 0.5 <= stops.mean().abs() <= 1.0


def test_noise_blur_and_balance_are_from_half_of_the_amount_to_all_of_it() -> None:
    camera = RIG.cameras["cam1"]
    even, point = torch.full((3, 24, 24), 0.5), torch.zeros(3, 24, 24)
    point[:, 11, 12] = 1.0
    places = torch.arange(24.0)
    found = []
    for seed in range(40):
        noise = CameraDisturbance(noise=0.02).image(even, camera, seeded(seed)).std()
        spot = CameraDisturbance(blur=2.0).image(point, camera, seeded(seed))[0]
        spread = (spot.sum(1) @ (places - 11).square()).sqrt(), (spot.sum(0) @ (places - 12).square()).sqrt()
        balanced = CameraDisturbance(white_balance=0.4).image(even, camera, seeded(seed)).mean((1, 2))
        found.append(
            torch.stack((noise / 0.02, *(s / 2 for s in spread), *torch.log2(balanced / 0.5) * 2.2 / 0.4))
        )
    low, high = torch.stack(found).abs().amin(0), torch.stack(found).abs().amax(0)
    assert ((low > 0.47) & (low < 0.6)).all()
    assert ((high > 0.9) & (high < 1.03)).all()
    signs = torch.stack(found)[:, 3:].sign()
    assert (signs.mean(0).abs() < 0.5).all()
    assert (signs != signs[:, :1]).any()


def test_vignetting_takes_light_by_the_square_of_the_angle() -> None:
    lens = FisheyeCamera.from_field_of_view((101, 101), math.radians(200))
    light = vignetted(torch.ones(3, 101, 101), lens, 0.6)[0] ** 2.2
    pixels = torch.tensor([[50.0, 50.0], [75.0, 50.0], [50.0, 10.0]])
    for u, v in pixels.long().tolist():
        angle = math.hypot(u - 50, v - 50) / 50.5  # equidistant: radius and angle are in proportion
        assert light[v, u] == pytest.approx(1 - 0.6 * angle**2, abs=1e-4)


def test_poses_are_off_by_the_angle_given() -> None:
    off = turned_poses(RIG, 0.05, seeded(1))
    relative = RIG.world_from_camera[:, :3, :3].mT @ off.world_from_camera[:, :3, :3]
    trace = relative.diagonal(dim1=-2, dim2=-1).sum(-1)
    torch.testing.assert_close(torch.acos((trace - 1) / 2), torch.full((3,), 0.05), atol=2e-3, rtol=0)
    torch.testing.assert_close(off.positions, RIG.positions)


@pytest.fixture
def inverted(monkeypatch: pytest.MonkeyPatch) -> None:
    """A disturbance of one's own that takes an image for its negative."""
    monkeypatch.setattr(DISTURBANCES, "things", dict(DISTURBANCES.things))

    @register_disturbance("inverted")
    def _(image: torch.Tensor, camera: object, amount: float, generator: object) -> torch.Tensor:
        return 2 * amount * (1 - image)


@pytest.mark.usefixtures("inverted")
def test_ones_own_comes_last_and_leaves_the_draws_of_others_alone() -> None:
    faults = {name: (1.0, most) for name, most in zip(AMOUNTS, (0.5, 0.8, 0.5, 0.1, 0.02, 1.0), strict=True)}
    plain = RandomFaults(None, 1.0, faults).draw(seeded(6))
    own = RandomFaults.of({"inverted": [1.0, 1.0], "disturbed": None, "grey": 1.0, **faults}).draw(seeded(6))
    amount = own.others["inverted"]
    assert 0 < amount < 1
    assert replace(own, others={}) == plain
    camera = RIG.cameras["cam1"]
    without, shown = (each.image(IMAGES["cam1"], camera, seeded(7)) for each in (plain, own))
    factor = (shown / (1 - without))[shown < 1]
    torch.testing.assert_close(factor, factor.mean().expand_as(factor))  # drawn from half of the amount on
    assert amount <= factor.mean() <= 2 * amount


@pytest.mark.usefixtures("inverted")
def test_disturbances_that_are_unknown_or_have_a_name_that_is_taken_are_refused() -> None:
    never = dict.fromkeys(AMOUNTS, (0.0, 0.0))
    for make in (
        lambda: CameraDisturbance(others={"mud": 1.0}),
        lambda: RandomFaults(None, 0.0, {**never, "mud": (1, 1)}),
    ):
        with pytest.raises(ArgumentError, match=r"'noise'.*'inverted'.*'mud'"):
            make()
    with pytest.raises(ArgumentError, match="inverted"):
        CameraDisturbance(others={"inverted": -1.0})
    for name in ("blur", "grey", "inverted"):
        with pytest.raises(ArgumentError, match=f"'{name}'"):
            register_disturbance(name)(lambda image, camera, amount, generator: image)


def test_random_rigs_stay_in_their_bounds() -> None:
    rigs = [random_rig(seeded(seed), image_size=(16, 16)) for seed in range(60)]
    views = [2 * math.degrees(float(rig.max_angles[0])) for rig in rigs if float(rig.max_angles[0]) < 3]
    assert 180 <= min(views) < 190 < 230 < max(views) <= 240.01
    assert {len(rig) for rig in rigs} == {2, 3, 4, 5, 6}
    assert 3 <= sum(isinstance(rig.cameras["cam1"], EquirectangularCamera) for rig in rigs) <= 24
    for rig in rigs:
        if isinstance(camera := rig.cameras["cam1"], EquirectangularCamera):  # pixels as those of 220° lenses
            assert camera.image_size[0] == pytest.approx(180 * 16 / 220, abs=1)
        assert rig.center.norm() < 1e-6
        assert (rig.positions.norm(dim=-1) < 0.45).all()
        assert (rig.axes[:, 1] > math.sin(math.radians(-23.1))).all()
        assert (rig.axes[:, 1] < math.sin(math.radians(53.1))).all()
        outwards = (rig.positions * rig.axes)[:, ::2].sum(-1)
        if len(rig) > 2:  # of two cameras the centre may be moved past one
            assert (outwards > -0.05).all()
    again = random_rig(seeded(7), image_size=(16, 16))
    assert torch.equal(again.world_from_camera, rigs[7].world_from_camera)


@pytest.mark.parametrize("kind", CARRIERS)
def test_a_carrier_is_where_masks_say(kind: str) -> None:
    """Pictures change where a ray from the camera meets the body, or its shadow and light, never the lens."""
    size = (44, 48)
    rig = make_corner_rig(image_size=size) if kind == "vehicle" else ring_rig(4, image_size=size)
    scene = make_scene("floating", seed=2)
    carried = with_carrier(scene, kind, rig)
    masks = carrier_masks(carried.body, rig)
    before, after = render_rig(scene, rig), render_rig(carried.scene, rig)
    for name in rig.names:
        seen = rig.cameras[name].unproject(rig.cameras[name].pixel_grid()).valid
        hidden = ~masks[name] & seen
        assert 0.01 < hidden.sum() / seen.sum() < 0.5
        pose = rig.world_from_camera[rig.names.index(name)]
        rays = rig.cameras[name].unproject(rig.cameras[name].pixel_grid()).directions @ pose[:3, :3].T
        hit = trace(carried.body, pose[:3, 3], rays).distance.isfinite()
        around = torch.nn.functional.unfold(hit[None, None].double(), 3, padding=1).any(1)[0].view(size)
        assert torch.equal(~masks[name], around)  # pixels that the body covers in part count as covered
        changed = (before[name] - after[name]).abs().amax(0) > 0.02
        assert changed[hidden].float().mean() > 0.5
        assert changed[masks[name]].float().mean() < 0.05  # shadows may fall
    assert (carried.body.distance_from(rig.positions[0]) > 0).all()
    assert (carried.body.distance_from(torch.tensor([0.0, 1.5, 0.0])) > 0.4).all()  # no floor is so near
    grid = torch.cartesian_prod(torch.arange(-30.0, 31), torch.tensor([1e3]), torch.arange(-30.0, 31))
    # Up from far below
    rays = torch.nn.functional.normalize(grid * torch.tensor([1 / 60, -1, 1 / 60]), dim=-1)
    hits = trace(carried.body, rig.center + torch.tensor([0.0, 1e3, 0.0]), rays).distance * rays[:, 1]
    floor = ray_depth(scene, rig.center, torch.tensor([0.0, 1.0, 0.0])).item()
    lowest = 1e3 + hits[hits.isfinite()].max().item()
    assert (floor if floor < 2 else 0.6) - lowest == pytest.approx(0.005, abs=0.006)
    up = Icosphere(3).vertices
    up = up[up[:, 1] < -0.5]
    # Nothing above
    torch.testing.assert_close(ray_depth(scene, rig.center, up), ray_depth(carried.scene, rig.center, up))
