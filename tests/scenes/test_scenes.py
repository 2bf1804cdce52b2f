# SPDX-License-Identifier: Apache-2.0
"""Scenes: seeds, light and shadow, textures, and agreement of pictures with rays."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import EquirectangularCamera, FisheyeCamera, ring_rig
from sphericalvision.scenes.kinds.palette import Palette
from sphericalvision.scenes.procedural import make_scene
from sphericalvision.scenes.registry import scene_kinds, under_other_skies
from sphericalvision.scenes.rendering.primitives import Part, pack
from sphericalvision.scenes.rendering.render import (
    _spread,
    _stratified,
    ray_depth,
    render_camera,
    render_directions,
    render_rig,
)
from sphericalvision.scenes.rendering.scene import Lamp, Material, Scene
from sphericalvision.scenes.rendering.shading import SurfaceTable, _albedo
from sphericalvision.scenes.rendering.textures import ALL_PATTERNS, pattern, photograph, texture_bank

ORIGIN = torch.zeros(3)
DOWN = torch.tensor([0.0, 1.0, 0.0])


def linear(picture: Tensor) -> Tensor:
    """Undo the display curve."""
    return picture**2.2


def plain(
    parts: list[Part], lamps: list[Lamp], ambient: float = 0.0, materials: list[Material] | None = None
) -> Scene:
    """A scene of white (or given) materials on black ground."""
    white = Material(texture=0, dark=(1.0, 1.0, 1.0), bright=(1.0, 1.0, 1.0))
    palette = Palette(torch.Generator())
    palette.materials = materials or [white]
    return palette.scene(parts, lamps, torch.full((3,), ambient))


def floor(y: float = 1.0, size: float = 10.0, material: int = 0) -> Part:
    return Part("box", (0.0, y + 0.5, 0.0), (size, 0.5, size), material)


@pytest.mark.parametrize("kind", scene_kinds())
def test_making_a_scene_leaves_the_global_generator_alone(kind: str) -> None:
    state = torch.get_rng_state()
    make_scene(kind, 0)
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("kind", scene_kinds())
@pytest.mark.parametrize("seed", range(6))
def test_scenes_keep_clear_of_the_rig_fill_the_hypotheses_and_are_closed(kind: str, seed: int) -> None:
    scene = make_scene(kind, seed)
    camera = EquirectangularCamera((64, 128))
    depth = ray_depth(scene, ORIGIN, camera.unproject(camera.pixel_grid()).directions)
    assert depth.min() >= 0.6 - 1e-4
    open_kinds = ("outdoors", "skies", "patchwork", "rough", "terrain", "ruins", "plain")
    least = 0.5 if kind in open_kinds else 0.7 if kind in ("glazed", "lit") else 0.95
    assert depth.isfinite().float().mean() > least
    assert depth.min() < (6 if kind == "terrain" else 3 if kind == "ruins" else 2)
    assert depth[depth.isfinite()].max() > 2.0


# May be white
@pytest.mark.parametrize("kind", [kind for kind in scene_kinds() if not under_other_skies(kind)])
def test_pictures_are_neither_dark_nor_washed_out(kind: str) -> None:
    directions = torch.nn.functional.normalize(torch.randn(2000, 3), dim=-1)
    scenes = [make_scene(kind, seed) for seed in range(8)]
    pictures = torch.stack([render_directions(scene, ORIGIN, directions) for scene in scenes])
    assert ((pictures.mean((1, 2)) > 0.25) & (pictures.mean((1, 2)) < 0.7)).all()
    assert (pictures.std(-1).mean(-1) > 0.05).all()
    assert (pictures.amin(1) == 1).float().mean() < 0.1


def test_pixels_that_the_camera_does_not_see_are_black() -> None:
    camera = FisheyeCamera.from_field_of_view((32, 40), math.radians(200))
    picture = render_camera(make_scene("room", 0), camera, torch.eye(4), samples_per_pixel=4)
    assert (picture[:, 0, 0] == 0).all()
    assert (picture[:, 16, 20] > 0).any()
    assert picture.shape == (3, 32, 40)


def test_a_rig_takes_the_pictures_of_its_cameras() -> None:
    rig, scene = ring_rig(image_size=(24, 24)), make_scene("floating", 1)
    pictures = render_rig(scene, rig)
    assert list(pictures) == list(rig.names)
    pose = rig.world_from_camera[2]
    assert torch.equal(pictures[rig.names[2]], render_camera(scene, rig.cameras[rig.names[2]], pose))


def test_autocast_around_it_changes_no_picture() -> None:
    rig, found = ring_rig(image_size=(8, 8)), []
    for mixed in (False, True):
        with torch.autocast("cpu", torch.bfloat16, enabled=mixed):
            scene = make_scene("skies", seed=3)
            found.append([*render_rig(scene, rig).values(), ray_depth(scene, ORIGIN, rig.axes)])
    torch.testing.assert_close(*found, rtol=0, atol=0)


def test_lambert_and_distance_law() -> None:
    """Light from a lamp straight above is color / (reach² + d²); at an angle, times the cosine."""
    height, reach, power = 2.0, 0.5, 3.0
    scene = plain([floor()], [Lamp((0.0, 1.0 - height, 0.0), (power,) * 3, reach)])
    x = torch.tensor([0.0, 0.5, 1.0, 3.0])
    points = torch.stack([x, torch.ones(4), torch.zeros(4)], -1)
    seen = linear(render_directions(scene, ORIGIN, torch.nn.functional.normalize(points, dim=-1)))
    squared = height**2 + x**2
    expected = power * height / squared.sqrt() / (reach**2 + squared)
    torch.testing.assert_close(seen[0], expected.clamp(max=1), rtol=2e-3, atol=1e-4)


def test_a_known_ball_casts_its_shadow_and_nothing_else() -> None:
    """The shadow of a ball right under a lamp is the disc inside the lamp's tangent cone."""
    lamp, middle, radius, ground = -2.0, -0.5, 0.4, 1.0
    ball = Part("ellipsoid", (0.0, middle, 0.0), (radius,) * 3)
    scene = plain([floor(ground), ball], [Lamp((0.0, lamp, 0.0), (20.0,) * 3)])
    edge = (ground - lamp) * math.tan(math.asin(radius / (middle - lamp)))
    x = torch.linspace(0.0, 2 * edge, 41)
    points = torch.stack([x, torch.full_like(x, ground), torch.zeros_like(x)], -1)
    eye = torch.tensor([0.0, 0.5, 3.0])
    seen = render_directions(scene, eye, torch.nn.functional.normalize(points - eye, dim=-1))[0]
    assert torch.equal(seen > 0, x > edge)
    through = replace(scene.primitives, casts_shadow=torch.tensor([True, False]))
    assert (render_directions(replace(scene, primitives=through), eye, points - eye)[0] > 0).all()


def test_a_mirror_shows_what_lies_in_the_reflected_direction() -> None:
    white = Material(texture=0, dark=(1.0, 1.0, 1.0), bright=(1.0, 1.0, 1.0))
    black_mirror = Material(texture=0, dark=(0.0,) * 3, bright=(0.0,) * 3, mirror=0.5)
    glow = Material(texture=0, dark=(0.8, 0.4, 0.2), bright=(0.8, 0.4, 0.2), emission=1.0)
    target = Part("ellipsoid", (0.0, 0.0, 4.0), (0.3, 0.3, 0.3), 2)
    scene = plain([floor(1.0, 10.0, 1), target], [], materials=[white, black_mirror, glow])
    # The floor point half-way reflects the ray to the ball at equal height.
    direction = torch.nn.functional.normalize(torch.tensor([0.0, 1.0, 2.0]), dim=-1)
    seen = linear(render_directions(scene, ORIGIN, direction[None]))[:, 0]
    torch.testing.assert_close(seen, torch.tensor([0.4, 0.2, 0.1]), rtol=1e-3, atol=1e-4)


def test_convention_down_is_the_floor() -> None:
    """The floor is 0.75 to 1.7 m below the rig, the ceiling higher above than any floor's clutter, or an object."""
    for seed in range(5):
        scene = make_scene("room", seed)
        assert 0.6 < ray_depth(scene, ORIGIN, DOWN) <= 1.7
        assert scene.lamps.position[0, 1] < 0


def test_objects_float_in_all_directions() -> None:
    """Their centers are as often above the rig as below it, and left as right: uniform on the sphere."""
    centers = torch.cat([make_scene("floating", seed).primitives.center[1:] for seed in range(6)])
    axes = torch.nn.functional.normalize(centers[centers.norm(dim=-1) > 0.1], dim=-1)
    assert len(axes) > 100
    assert axes.mean(0).abs().max() < 0.15
    torch.testing.assert_close(axes.square().mean(0), torch.full((3,), 1 / 3), rtol=0, atol=0.08)


PATTERN_OF_A_SEED = {
    "noise": (0.4516, 0.0221, 0.0396),
    "checks": (0.5024, 0.1060, 0.1053),
    "stripes": (0.6274, 0.0187, 0.1300),
    "bricks": (0.5376, 0.1619, 0.0852),
    "wood": (0.5347, 0.0178, 0.0970),
    "tiles": (0.6088, 0.0694, 0.0714),
    "mosaic": (0.4339, 0.0555, 0.0538),
    "dots": (0.4144, 0.0711, 0.0703),
    "marble": (0.4003, 0.1265, 0.1287),
    "weave": (0.5767, 0.0892, 0.0891),
    "spectrum": (0.3978, 0.0229, 0.0234),
    "cells": (0.3861, 0.1444, 0.1375),
    "specks": (0.9866, 0.0230, 0.0216),
}
"""Pattern -> of one seed the mean, and the mean steps from pixel to pixel down and across."""


@pytest.mark.parametrize("name", ALL_PATTERNS)
def test_patterns_stay_what_scenes_of_before_were_painted_with(name: str) -> None:
    image = pattern(name, torch.Generator().manual_seed(1), size=64)
    assert image.shape == (3, 64, 64)
    assert 0 <= image.min() <= image.max() <= 1
    steps = (image.diff(dim=axis).abs().mean().item() for axis in (1, 2))
    assert (image.mean().item(), *steps) == pytest.approx(PATTERN_OF_A_SEED[name], abs=2e-4)


def test_texture_lookup_at_texel_centres_and_over_everything(generator: torch.Generator) -> None:
    bank = texture_bank()
    image = photograph("coffee.png")
    number = torch.full((100,), bank.names.index("coffee.png"))
    column, row = torch.randint(0, bank.size, (2, 100), generator=generator)
    uv = (torch.stack([column, row], -1) + 0.5) / bank.size
    fine = bank.columns(number, *uv.T, torch.zeros(100)).T
    torch.testing.assert_close(fine, image[:, row, column].T, rtol=0, atol=0.005)
    coarse = bank.columns(number, *uv.T, torch.full((100,), 5.0)).T
    torch.testing.assert_close(coarse, image.mean((1, 2)).expand(100, 3), rtol=0, atol=0.005)


def test_texture_lookup_is_trilinear_between_mirrored_texels(generator: torch.Generator) -> None:
    """One look-up after another in float64, from the texels' bytes."""
    bank = texture_bank()
    uv = 6 * torch.rand(300, 2, generator=generator) - 3
    footprint = 2.0 ** (10 * torch.rand(300, generator=generator) - 9)
    texture = torch.randint(0, len(bank.names), (300,), generator=generator)
    levels = [bank.size >> k for k in range(bank.num_levels)]

    def texel(number: int, level: int, row: int, column: int) -> Tensor:
        side = levels[level]
        row, column = (min(k % (2 * side), 2 * side - 1 - k % (2 * side)) for k in (row, column))
        start = number * sum(s * s for s in levels) + sum(s * s for s in levels[:level])
        return (bank.texels[start + row * side + column, :3].double() / 255) ** 2

    for k, seen in enumerate(bank.columns(texture, *uv.T, footprint).T):
        exact = min(max(math.log2(footprint[k].item() * bank.size), 0.0), bank.num_levels - 1.0)
        expected = torch.zeros(3, dtype=torch.float64)
        for level in {math.floor(exact), math.ceil(exact)}:
            x, y = (uv[k].double() * levels[level] - 0.5).tolist()
            for row in (math.floor(y), math.floor(y) + 1):
                for column in (math.floor(x), math.floor(x) + 1):
                    share = (1 - abs(exact - level)) * (1 - abs(y - row)) * (1 - abs(x - column))
                    expected += share * texel(int(texture[k]), level, row, column)
        torch.testing.assert_close(seen.double(), expected, rtol=1e-3, atol=1e-3)


def checked(wall: Part, *more: Material) -> Scene:
    """A wall with a fine texture, and light from everywhere."""
    fine = Material(texture=0, dark=(0.0,) * 3, bright=(0.5,) * 3, tile=(0.5, 0.5))
    return plain([wall], [], ambient=1.0, materials=[fine, *more])


def test_a_surface_at_a_slant_is_averaged_as_over_the_root_of_its_stretch() -> None:
    """Of a ray that meets it at a cosine of a quarter as of one twice as wide that meets it head on."""
    table = SurfaceTable.of(checked(floor()))
    uv, row = torch.rand(2, 64, generator=torch.Generator().manual_seed(0)), torch.zeros(64).long()
    normal = torch.tensor([0.0, -1.0, 0.0])[:, None].expand(3, 64)
    slanted = torch.tensor([math.sqrt(15) / 4, 0.25, 0.0])[:, None].expand(3, 64)
    width = torch.full((64,), 0.01)
    at_slant, head_on, narrow = (
        _albedo(table, uv, normal, ray, row, w)[0]
        for ray, w in ((slanted, width), (-normal, 2 * width), (-normal, width))
    )
    torch.testing.assert_close(at_slant, head_on)
    assert (head_on - narrow).abs().max() > 0.01


def test_a_mirror_half_way_shows_a_wall_as_it_is_seen_without_it() -> None:
    """As coarse as from where the eye is mirrored to."""
    wall = Part("box", (0.0, 0.0, -0.511), (9.0, 9.0, 0.5), 0)
    mirror = Part("box", (0.0, 0.0, 1.5), (9.0, 9.0, 0.5), 1)
    mirrors = Material(texture=0, dark=(0.0,) * 3, bright=(0.0,) * 3, mirror=1.0)
    alone = checked(wall)
    both = replace(checked(wall, mirrors), primitives=pack([wall, mirror]))
    angles = torch.linspace(0.3, 0.6, 400)
    rays = torch.stack((angles.sin(), 0 * angles, angles.cos()), -1)
    reflected = render_directions(both, ORIGIN, rays, spread=0.02)
    eye, back = torch.tensor([0.0, 0.0, 2.0]), rays * torch.tensor([1.0, 1.0, -1.0])
    direct, fine = (render_directions(alone, eye, back, spread=spread) for spread in (0.02, 0.01))
    assert (direct - fine).abs().mean() > 0.01
    assert (reflected - direct).abs().mean() < 0.003


def test_a_pixel_is_the_mean_of_the_light_of_samples_that_the_camera_sees() -> None:
    """By hand; each of four covers a quarter of the pixel, and at the rim of the view only some are seen."""
    scene = checked(Part("box", (0.0, 0.0, 2.0), (9.0, 9.0, 0.5)))
    camera = FisheyeCamera.from_field_of_view((24, 24), math.radians(100))
    total, count = torch.zeros(3, 24, 24), torch.zeros(24, 24)
    for offset in _stratified(4):
        rays, seen = camera.unproject(camera.pixel_grid() + offset)
        light = linear(render_directions(scene, ORIGIN, rays, spread=_spread(rays) / 2))
        total, count = total + light * seen, count + seen
    assert ((count > 0) & (count < 4)).any()
    picture = linear(render_camera(scene, camera, torch.eye(4), samples_per_pixel=4))
    torch.testing.assert_close(picture, total / count.clamp(min=1), rtol=1e-3, atol=1e-4)


def test_pixels_of_a_panorama_are_at_most_twice_as_coarse_as_they_are_narrow() -> None:
    """Near a pole a pixel is narrow: textures are not averaged over its height."""
    camera = EquirectangularCamera((32, 64))
    rays = camera.unproject(camera.pixel_grid()).directions
    height = math.pi / 32
    narrow = height * rays[:, 0, [0, 2]].norm(dim=-1)
    expected = torch.full_like(narrow, height).minimum(2 * narrow)[:, None].expand(32, 64)
    torch.testing.assert_close(_spread(rays), expected, rtol=5e-3, atol=0)
