# SPDX-License-Identifier: Apache-2.0
"""What each kind of scene promises: sky at infinity, floors that mirror, bare walls, length, height."""

import math
import statistics
from dataclasses import fields, replace
from importlib.metadata import EntryPoint, EntryPoints

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import EquirectangularCamera, FisheyeCamera
from sphericalvision.core import ArgumentError
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.icosphere import Icosphere
from sphericalvision.recipes.evaluation.tracks import TRACKS
from sphericalvision.scenes import registry
from sphericalvision.scenes.procedural import make_scene
from sphericalvision.scenes.registry import kind_of, register_scene, scene_kinds, scene_recipe
from sphericalvision.scenes.rendering.render import ray_depth, render_camera, render_directions
from sphericalvision.scenes.rendering.scene import Scene
from tests.values import coarse_sum, weighted_sum

ORIGIN = torch.zeros(3)
UP, DOWN = torch.tensor([0.0, -1.0, 0.0]), torch.tensor([0.0, 1.0, 0.0])


MEANT: dict[str, tuple[float, float]] = {
    "room": (8.8846, -0.239), "floating": (20.6121, -1.146), "hall": (-0.7885, 1.163), "corridor": (21.4033, 0.254),
    "bare": (19.8028, 0.628), "polished": (16.7103, -0.642), "outdoors": (-19.9373, 0.682), "glazed": (2.7408, -1.122),
    "lit": (39.7345, -2.203), "patchwork": (-54.0143, -1.126), "plain": (-16.9697, 0.541), "rough": (26.1526, -1.521),
    "ruins": (56.3069, 4.797), "skies": (-19.9373, 1.697), "terrain": (-95.4386, 0.759),
}  # fmt: skip
"""Of each kind a sum over all numbers of five scenes, and over the colours of pictures of two, as they are used."""


def sum_of_numbers(kind: str) -> float:
    total = 0.0
    for seed in range(5):
        scene = scene_recipe(kind)(torch.Generator().manual_seed(seed), 0.6)
        parts = (scene, scene.primitives, scene.materials, scene.lamps)
        values = [getattr(part, each.name) for part in parts for each in fields(part)]
        total += weighted_sum(*(v.double().asinh() for v in values if isinstance(v, Tensor))) + scene.fog
    return total


def sum_of_colors(kind: str) -> float:
    """Through a lens that stands aside, turned, in scenes that are moved and scaled."""
    pose = transform_from_axis_angle(torch.tensor([0.3, 0.7, -0.2]), torch.tensor([2.1, -1.0, 0.6]))
    lens, center = FisheyeCamera.from_field_of_view((28, 36), 3.7), torch.tensor([2.0, -1.1, 0.5])
    scenes = (make_scene(kind, seed, center=center, scale=1.4) for seed in (3, 5))
    return coarse_sum(*(render_camera(scene, lens, pose) for scene in scenes))


@pytest.mark.parametrize("kind", MEANT)
def test_a_seed_is_the_scene_that_it_was(kind: str) -> None:
    """Or caches, benchmarks and trainings that go on have other scenes than they say."""
    assert sum_of_numbers(kind) == pytest.approx(MEANT[kind][0], abs=0.002)
    assert sum_of_colors(kind) == pytest.approx(MEANT[kind][1], abs=0.02)


def around(elevation: float = 0.0, count: int = 720) -> Tensor:
    """Directions all around, at an elevation in radians."""
    angle = torch.arange(count) * (2 * math.pi / count)
    flat = torch.stack([angle.sin(), torch.zeros(count), angle.cos()], -1) * math.cos(elevation)
    return flat - math.sin(elevation) * DOWN


def some(kind: str, count: int = 6) -> list[Scene]:
    """The first few scenes of a kind."""
    return [make_scene(kind, seed) for seed in range(count)]


def depths(scenes: list[Scene], directions: Tensor) -> Tensor:
    """Depth ``(scenes, *)``."""
    return torch.stack([ray_depth(scene, ORIGIN, directions) for scene in scenes])


def test_turns_of_the_benchmark_stay() -> None:
    turns = ("room", "floating", "hall", "corridor", "bare", "polished", "outdoors")
    assert tuple(kind_of(TRACKS["clean"].kind, seed) for seed in range(8)) == (*turns, "room")


def test_a_kind_is_registered_by_one_decorator(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry.KINDS, "things", dict(registry.KINDS.things))

    @register_scene("twin", other_sky=True)
    def twin(generator: torch.Generator, clear_radius: float) -> Scene:
        return scene_recipe("outdoors")(generator, clear_radius)

    assert "twin" in scene_kinds()
    directions = around()
    for kind, seed in (("skies", 4), ("twin", 4)):
        assert kind_of(kind, seed) == kind
    both = [render_directions(make_scene(kind, 4), ORIGIN, directions) for kind in ("skies", "twin")]
    assert torch.equal(*both)
    with pytest.raises(ArgumentError, match="kind: 'room'"):
        register_scene("room")(twin)


def test_a_kind_is_found_by_its_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry.KINDS, "things", dict(registry.KINDS.things))
    entry = EntryPoint("elsewhere", "sphericalvision.scenes.kinds.halls:random_hall", registry.ENTRY_POINTS)
    monkeypatch.setattr("sphericalvision.extensions.entry_points", lambda group, **_: EntryPoints([entry]))
    assert "elsewhere" in scene_kinds()
    one, other = make_scene("elsewhere", 2), make_scene("hall", 2)
    assert torch.equal(one.materials.dark, other.materials.dark)


def test_skies_are_those_of_outdoors_in_other_colours_at_the_same_depth() -> None:
    high, low = around(1.2), around(-0.6)
    seen = {}
    for seed in range(30):
        plain, other = make_scene("outdoors", seed), make_scene("skies", seed)
        assert torch.equal(ray_depth(plain, ORIGIN, high), ray_depth(other, ORIGIN, high))
        assert torch.equal(render_directions(plain, ORIGIN, low), render_directions(other, ORIGIN, low))
        sky = render_directions(other, ORIGIN, UP[None])
        plain_sky = "black" if sky.amax() == 0 else "white" if sky.amin() > 0.9 else "any"
        kind = "clouds" if len(other.clouds) else plain_sky
        seen.setdefault(kind, []).append(sky)
    assert set(seen) == {"clouds", "black", "white", "any"}
    hues = torch.stack(seen["any"]).flatten(1)
    assert (hues[:, 0] > hues[:, 2]).any()
    assert (hues[:, 0] < hues[:, 2]).any()


def test_patchworks_are_open_or_closed_and_seen_from_any_height() -> None:
    scenes = some("patchwork", 60)
    down, up = depths(scenes, DOWN), depths(scenes, UP)
    assert 0.25 < up.isinf().float().mean() < 0.55
    assert (down < 0.9).any()
    assert (down > 3).any()
    assert {len(scene.lamps.position) for scene in scenes} == {0, 1, 2}


def test_rough_places_are_caves_and_slopes_without_anything_level_or_upright() -> None:
    scenes = some("rough", 40)
    below, above = (depths(scenes, around(elevation, 90)) for elevation in (-1.0, 1.0))
    assert 0.2 < above.isinf().any(1).float().mean() < 0.6
    assert below.isfinite().all()
    # A level floor without anything on it would be equally far in all directions of one elevation.
    uneven = below.quantile(0.9, 1) / below.quantile(0.1, 1)
    assert uneven.median() > 1.3
    assert {len(scene.lamps.position) for scene in scenes} == {0, 1, 2}


def test_terrain_is_uneven_at_all_scales_and_reaches_far_below_the_open_sky() -> None:
    scenes = some("terrain", 16)
    below, above = (depths(scenes, around(elevation, 90)) for elevation in (-0.6, 0.6))
    assert below.isfinite().all()
    assert (below.quantile(0.9, 1) / below.quantile(0.1, 1)).median() > 1.3
    assert above.isinf().float().mean() > 0.6
    level = depths(scenes, around(-0.02, 360))
    assert ((level > 50) & level.isfinite()).any(1).float().mean() > 0.5
    assert 0.1 < sum(scene.fog > 0 for scene in scenes) / 16 < 0.5


def test_ruins_are_partly_roofed_and_one_sees_far_between_their_walls() -> None:
    scenes = some("ruins", 16)
    up = depths(scenes, UP)
    assert 0.3 < up.isinf().float().mean() < 0.9
    assert up[up.isfinite()].max() < 6
    flat = depths(scenes, around(-0.01))
    assert (flat < 6).float().mean() > 0.25
    assert ((flat > 50) & flat.isfinite()).any(1).float().mean() > 0.9


def test_plain_places_have_few_colours_in_even_light_and_some_have_no_roof() -> None:
    scenes = some("plain", 24)
    assert 0.04 < depths(scenes, UP).isinf().float().mean() < 0.4
    assert 0.3 < sum(len(scene.lamps.position) == 0 for scene in scenes) / 24 < 0.8

    def colours(scene: Scene) -> int:
        """How many different ones rays to all sides meet."""
        rays = Icosphere(4).vertices
        picture, depth = render_directions(scene, ORIGIN, rays), ray_depth(scene, ORIGIN, rays)
        return len((picture[:, depth.isfinite()].T * 255).round().unique(dim=0))

    assert 4 * statistics.median(map(colours, scenes)) < statistics.median(map(colours, some("room", 5)))


def test_what_shines_in_a_lit_place_is_as_bright_as_a_sky_and_as_near_as_its_walls() -> None:
    rays = Icosphere(4).vertices

    def dazzling(scene: Scene) -> Tensor:
        """Depth of what is bright in a scene; NaN elsewhere."""
        bright = render_directions(scene, ORIGIN, rays).mean(0) > 0.9
        return torch.where(bright, ray_depth(scene, ORIGIN, rays), torch.nan)

    lit, rooms = (torch.stack([*map(dazzling, some(kind, 24))]) for kind in ("lit", "room"))
    assert (lit < 40).float().mean() > 2 * (rooms < 40).float().mean()
    assert ((lit < 40).float().mean(1) > 0.01).float().mean() > 0.4
    assert 0.1 < lit.isinf().any(1).float().mean() < 0.7  # panes before a sky as bright, in some


def test_fog_turns_what_is_far_into_the_sky_and_leaves_depth() -> None:
    clear = replace(make_scene("outdoors", 1), clouds=torch.zeros(0, 5))
    directions = around(-0.03)
    depth = ray_depth(clear, ORIGIN, directions)
    none = replace(clear, primitives=clear.primitives.transformed(translation=1e6 * DOWN))
    plain, sky = (render_directions(scene, ORIGIN, directions) ** 2.2 for scene in (clear, none))
    for scale in (1.0, 2.0):
        foggy = replace(clear, fog=0.2).scaled(scale)
        assert torch.allclose(ray_depth(foggy, ORIGIN, directions), scale * depth, rtol=1e-3)
        seen = render_directions(foggy, ORIGIN, directions) ** 2.2
        expected = sky.lerp(plain, torch.exp(-0.2 * depth))
        unclipped = (plain < 0.99).all(0)
        assert (seen - expected).abs()[:, unclipped].quantile(0.99) < 0.02


def test_glazed_rooms_are_closed_above_and_below_and_open_to_the_sky_at_their_sides() -> None:
    scenes = some("glazed", 40)
    assert depths(scenes, torch.stack([UP, DOWN])).max() < 3.6
    level = depths(scenes, around(0.1))
    beyond = (level > 6 * 2**0.5 + 1e-3).float().mean(1)  # no corner of the room is as far
    assert (beyond > 0).float().mean() > 0.85
    assert beyond.max() > 0.3
    assert 0.5 < level.isinf().any(1).float().mean() < 1.0
    assert len({tuple(scene.background.flatten().tolist()) for scene in scenes}) > 20


def test_a_scene_without_anything_that_casts_a_shadow_is_lit() -> None:
    scene = make_scene("bare", seed=0)
    shadowless = replace(scene.primitives, casts_shadow=torch.zeros_like(scene.primitives.casts_shadow))
    assert len(shadowless.shadow_casters) == 0
    seen = render_directions(replace(scene, primitives=shadowless), ORIGIN, around(0.3))
    assert (seen >= render_directions(scene, ORIGIN, around(0.3)) - 1e-5).all()


def test_clouds_cover_part_of_the_sky_and_stay_where_they_are() -> None:
    scene = next(s for s in some("skies", 30) if len(s.clouds))
    high = around(1.0)
    seen = render_directions(scene, ORIGIN, high)
    assert seen.std(-1 if seen.shape[0] == 3 else 0).amax() > 0.02
    moved = render_directions(scene, torch.tensor([0.3, 0.0, 0.0]), high)
    assert ((moved - seen).abs() < 1e-6).float().mean() > 0.8
    assert torch.equal(scene.scaled(2.0).transformed(translation=torch.ones(3)).clouds, scene.clouds)
    assert torch.equal(scene.to("cpu").clouds, scene.clouds)


def test_the_sky_is_infinitely_far_and_the_ground_reaches_the_horizon() -> None:
    scenes = some("outdoors")
    high, low = depths(scenes, around(1.2)), depths(scenes, around(-0.3))
    assert high.isinf().float().mean() > 0.8
    assert (high.reciprocal()[high.isinf()] == 0).all()
    assert low.isfinite().all()
    horizon = depths(scenes, around(-0.004))
    assert horizon.isfinite().all()
    assert horizon.max() > 100
    sky = render_directions(scenes[0], ORIGIN, UP[None])
    assert sky[2] > sky[0]  # bluish
    assert sky.min() > 0.1


def test_the_sun_throws_shadows() -> None:
    """Without its lamp, less light arrives at the ground, but not everywhere less."""
    scene = make_scene("outdoors", 2)
    dark = replace(scene, lamps=replace(scene.lamps, color=0 * scene.lamps.color))
    ground = torch.cat([around(-e) for e in (0.3, 0.5, 0.7)])
    gain = render_directions(scene, ORIGIN, ground).mean(0) - render_directions(dark, ORIGIN, ground).mean(0)
    assert gain.median() > 0.05
    assert (gain.abs() < 1e-6).float().mean() > 0.01


def without_mirrors(scene: Scene) -> Scene:
    return replace(scene, materials=replace(scene.materials, mirror=0 * scene.materials.mirror))


def test_polished_floors_mirror_and_depth_is_that_of_the_floor() -> None:
    for scene in some("polished"):
        floor = around(-0.35, 360)
        depth = ray_depth(scene, ORIGIN, floor)
        height = ray_depth(scene, ORIGIN, DOWN)
        on_floor = ((depth * math.sin(0.35) - height).abs() < 1e-3) & (height > 0.7)
        assert on_floor.float().mean() > 0.1
        assert torch.equal(depth, ray_depth(without_mirrors(scene), ORIGIN, floor))
        # What shows on the floor is the room above it, mixed with the floor's own colour.
        rays, depth = floor[on_floor][::12], depth[on_floor][::12]
        dull = without_mirrors(scene)
        seen, matt = (render_directions(s, ORIGIN, rays) for s in (scene, dull))
        upwards = rays * torch.tensor([1.0, -1.0, 1.0])
        starts = depth[:, None] * rays + 2e-3 * UP
        mirrored = [render_directions(dull, *spot) for spot in zip(starts, upwards[:, None], strict=True)]
        share = scene.materials.mirror[scene.primitives.material[0]]
        assert share > 0.3
        expected = (matt**2.2).lerp(torch.cat(mirrored, 1) ** 2.2, share) ** (1 / 2.2)
        assert (seen - expected).abs().median() < 0.02
        assert (seen - matt).abs().mean() > 0.02


def roughness(kind: str) -> Tensor:
    """Median second difference of neighbouring pixels ``(seeds,)`` in pictures of the walls, in levels of 255."""
    camera = EquirectangularCamera((64, 128))
    pictures = [render_camera(scene, camera, torch.eye(4)) for scene in some(kind)]
    return torch.stack([255 * p[:, 16:40].diff(n=2, dim=-1).abs().median() for p in pictures])


def test_bare_walls_have_next_to_no_texture() -> None:
    bare, furnished = roughness("bare"), roughness("room")
    assert bare.median() < 0.5
    assert bare.median() < furnished.median() / 2


def test_corridors_are_long_and_narrow() -> None:
    scenes = some("corridor")
    flat = depths(scenes, around())
    across = flat.nan_to_num(posinf=1e3).quantile(0.2, dim=1)
    assert (across < 3).all()
    assert (flat.amax(1) > 4 * across).all()
    assert (depths(scenes, UP) < 3.2).all()


def test_halls_are_wide_and_high() -> None:
    scenes = some("hall")
    flat = depths(scenes, around())
    assert (flat.median(1).values > 2).all()
    assert flat.median() > 1.5 * depths(some("room"), around()).median()
    assert (depths(scenes, torch.stack([UP, *around(1.4, 20)])).amax(1) > 2.9).all()


@pytest.mark.parametrize("kind", scene_kinds())
def test_scenes_of_any_scale_look_alike(kind: str) -> None:
    directions = torch.nn.functional.normalize(torch.randn(400, 3), dim=-1)
    once, thrice = (make_scene(kind, 5, scale=scale) for scale in (1.0, 3.0))
    near, far = (ray_depth(scene, ORIGIN, directions) for scene in (once, thrice))
    assert torch.isclose(3 * near, far, rtol=1e-3).float().mean() > 0.99
    colors = [render_directions(scene, ORIGIN, directions) for scene in (once, thrice)]
    assert ((colors[0] - colors[1]).abs() < 0.05).float().mean() > 0.97
