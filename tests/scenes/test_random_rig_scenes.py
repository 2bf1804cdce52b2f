# SPDX-License-Identifier: Apache-2.0
"""Samples through random rigs: each follows from its seed alone."""

from __future__ import annotations

import math
from collections import Counter

import pytest
import torch

from sphericalvision.cameras import ring_rig
from sphericalvision.core import ArgumentError
from sphericalvision.data import SampleView
from sphericalvision.icosphere import Icosphere
from sphericalvision.scenes import World
from sphericalvision.scenes.disturbances import DISPLAY
from sphericalvision.scenes.draws import Draws
from sphericalvision.scenes.procedural import make_scene
from sphericalvision.scenes.rendering.render import ray_depth, render_directions, render_rig
from sphericalvision.scenes.world import CLEAR_RADIUS
from tests.values import coarse_sum, weighted_sum
from tests.worlds import RANDOM_RIGS, random_rigs, same
from tests.worlds import scenes as world_scenes

VALUES = RANDOM_RIGS
UNDISTURBED = {**VALUES, "faults": {**VALUES["faults"], "disturbed": 0.0}}


def test_a_seed_is_a_sample_with_a_cache_and_without(tmp_path):
    plain, kept = random_rigs(4, 7), random_rigs(4, 7, cache_dir=tmp_path)
    for index in range(4):
        first, second = kept[index], kept[index]
        assert same(first, second)
        assert same(first, plain[index])
        assert torch.equal(second["rig"].world_from_camera, plain[index]["rig"].world_from_camera)
    assert same(random_rigs(1, 9)[0], plain[2])
    assert random_rigs().world.fingerprint() != random_rigs(values=UNDISTURBED).world.fingerprint()


def test_samples_are_what_they_say():
    scenes = random_rigs(6, 20, values=UNDISTURBED)
    for sample in (scenes[index] for index in range(6)):
        assert sample["images"].shape == (len(sample["rig"]), 3, 642)
        assert (sample["images"].movedim(1, -1)[~sample["seen"]] == 0).all()
        kind, _, seed = sample["frame"].rpartition("-")
        depth = ray_depth(make_scene(kind, int(seed)), sample["rig"].center, Icosphere(3).vertices)
        torch.testing.assert_close(sample["inverse_depth"], depth.reciprocal())


def test_rigs_and_scenes_are_of_all_kinds():
    scenes = random_rigs(300)
    frames = [scenes.world.frame(seed) for seed in range(300)]
    shares = VALUES["kind"]
    kinds = Counter(frame.kind for frame in frames)
    assert set(kinds) == set(shares)
    total = sum(shares.values())
    assert all(abs(kinds[kind] / 300 - share / total) < 0.08 for kind, share in shares.items())
    assert {len(frame.true_rig) for frame in frames[:60]} == {2, 3, 4, 5, 6}
    off = [frame.posed_rig is not frame.true_rig for frame in frames[:60]]
    assert 0.1 < sum(off) / 60 < 0.6


def test_scenes_have_other_skies_and_some_no_lamps():
    scenes = random_rigs(60, values={**VALUES, "kind": {"bare": 1.0}})
    own = [make_scene("bare", seed) for seed in range(60)]
    others = [scenes.world.frame(seed).scene for seed in range(60)]
    under = [not torch.equal(a.background, b.background) for a, b in zip(own, others, strict=True)]
    assert 0.4 < sum(under) / 60 < 0.8
    dull = [len(scene.lamps.position) == 0 for scene in others]
    assert 0.03 < sum(dull) / 60 < 0.3
    assert all(len(scene.lamps.position) for scene in own)
    for scene, other, without in zip(own, others, dull, strict=True):
        directions = Icosphere(3).vertices
        assert torch.equal(*(ray_depth(x, torch.zeros(3), directions) for x in (scene, other)))
        seen = render_directions(other, torch.zeros(3), directions)
        assert 0.2 < seen.mean() < 0.8, "too dark or too bright" + " without lamps" * without


def test_some_samples_are_too_bright():
    scenes = random_rigs(300, values=UNDISTURBED)
    stops = torch.tensor([DISPLAY * math.log2(scenes.world.frame(seed).gain) for seed in range(300)])
    bright = stops > 0
    assert 0.2 < bright.float().mean() < 0.4
    assert stops[bright].min() >= 0.3 - 1e-6
    assert stops.max() <= 2.5 + 1e-6
    brightest = int(stops.argmax())
    frame = scenes.world.frame(brightest)
    usual = render_rig(make_scene(frame.kind, brightest), frame.true_rig)
    shown = scenes[brightest]["images"]
    assert (shown.where(shown > -1, 0).mean() + 1) / 2 > torch.stack(list(usual.values())).mean()


def test_photographs_are_prepared_as_in_use(tmp_path):
    given = []

    def darkened(rig, images):
        given.append((rig, images))
        return {name: image / 2 for name, image in images.items()}

    plain, dark = random_rigs(2, 40), random_rigs(2, 40, prepare=darkened)
    assert plain.world.fingerprint() != dark.world.fingerprint()
    seen = plain[0]["seen"][:, None]
    torch.testing.assert_close(
        dark[0]["images"] + 1, ((plain[0]["images"] + 1) / 2).where(seen, 1), atol=0.02, rtol=0
    )
    ((rig, images),) = given
    assert torch.equal(rig.world_from_camera, plain[0]["rig"].world_from_camera)
    assert set(images) == set(rig.names)


def test_what_happens_how_often_is_plain_values():
    values = VALUES
    faults = {**values["faults"], "disturbed": 1.0, "grey": 1.0, "noise": [0.0, 0.0]}
    grey = random_rigs(1, 30, values={**values, "carrier": 1.0, "faults": faults})
    spread = grey[0]["images"].amax(1) - grey[0]["images"].amin(1)
    assert spread.max() < 0.02  # but for rounding to bytes
    assert grey.world.fingerprint() != random_rigs(1, 30).world.fingerprint()
    for wrong, name in (
        ({"carriers": 0.3}, "carriers"),
        ({"carrier": 1.3}, "carrier"),
        ({"faults": {"grey": 1.0}}, "faults"),
        ({"faults": {**faults, "blur": [2.0, 1.0]}}, r"faults\.blur"),
    ):
        with pytest.raises(ArgumentError, match=name):
            random_rigs(1, values={**values, **wrong})


def test_scenes_without_lamps_are_as_bright_wherever_the_rig_is():
    rig = ring_rig(3, image_size=(24, 24))
    poses = rig.world_from_camera.clone()
    poses[:, :3, 3] += torch.tensor([30.0, -4.0, 20.0])
    for seed in range(3):
        here, there = (World(r, unlit=1.0).frame(seed) for r in (rig, rig.replaced(world_from_camera=poses)))
        torch.testing.assert_close(there.scene.exposure, here.scene.exposure, rtol=0.01, atol=0)


def test_a_carrier_is_in_view_and_in_the_truth_where_it_counts():
    rig, down = ring_rig(3, image_size=(24, 24)), torch.tensor([0.0, 1.0, 0.0])
    frames = [World(rig, carrier="pole", carrier_counts=counts).frame(3) for counts in (True, False)]
    near, far = (1 / frame.inverse_depth(down) for frame in frames)
    assert near < 0.1
    assert far > 0.6
    assert torch.equal(frames[0].images["cam1"], frames[1].images["cam1"])
    assert not frames[0].rig.masks
    hidden = World(rig, carrier="pole", masked=1.0).frame(3).rig.masks
    assert set(hidden) == set(rig.names)
    assert not any(mask.all() for mask in hidden.values())
    lower = {"cam1": torch.arange(24)[:, None].expand(24, 24) > 3}
    both = World(rig.replaced(masks=lower), carrier="pole", masked=1.0).frame(3).rig.masks
    assert torch.equal(both["cam1"], hidden["cam1"] & lower["cam1"])
    sometimes = World(rig, carrier="pole", masked=0.3)
    assert 5 < sum(bool(sometimes.frame(seed).rig.masks) for seed in range(40)) < 20


def test_clutter_comes_in_its_share_of_scenes_before_what_is_there_and_keeps_clear_of_the_rig():
    rig, kinds, rays = (
        ring_rig(3, image_size=(24, 24)),
        ["bare", "outdoors", "floating"],
        Icosphere(3).vertices,
    )
    worlds = [World(rig, kinds, clutter=share) for share in (0.0, 1.0)]
    seen_in = 0
    for seed in range(9):
        without, within = (world.frame(seed) for world in worlds)
        nearer = within.inverse_depth(rays) - without.inverse_depth(rays)
        assert nearer.min() >= -1e-5
        seen_in += bool(nearer.max() > 0.1)
        added = within.scene.primitives.distance_from(rig.center)[len(without.scene.primitives) :]
        assert (added > CLEAR_RADIUS - 1e-4).all()
        assert len(within.shown.materials.texture) > within.shown.primitives.material.max()
    assert seen_in >= 6  # now and then nothing has room, and thin bars are between the rays
    large = World(rig, kinds, clutter=1.0, min_depth=1.1).frame(2)
    assert torch.allclose(2 * large.inverse_depth(rays), worlds[1].frame(2).inverse_depth(rays), atol=1e-4)
    sizes = [
        len(World(rig, "bare", clutter=share).frame(seed).scene.primitives)
        for seed in range(40)
        for share in (0.0, 0.3)
    ]
    assert 5 < sum(after > before for before, after in zip(sizes[::2], sizes[1::2], strict=True)) < 20


KNOWN = {
    0: ("rough", 3, 0.1412, True, True, 1.0, 0.0, 0.0, 12, 1.3011, -0.007, -6.573),
    1: ("glazed", 3, 0.1573, True, False, 1.5323, 0.01918, 0.004915, 60, 2.8907, 0.258, -1.0),
    3: ("hall", 2, 0.0876, False, False, 2.1022, 0.0, 0.0, 70, 0.5371, -1.677, -0.944),
    5: ("patchwork", 4, 0.2, False, False, 2.1401, 0.0, 0.0, 17, 0.2575, 0.672, 0.259),
    12: ("polished", 4, 0.2, True, False, 1.5018, 0.03251, 0.001288, 81, 4.0428, -0.418, -2.854),
    13: ("corridor", 2, 0.1458, False, False, 1.0, 0.00719, 0.002379, 47, 1.2219, -4.236, -2.606),
    30: ("room", 4, 0.0894, True, True, 2.1075, 0.02807, 0.004368, 80, 2.7779, -1.126, 1.009),
}
"""Of seeds: kind, cameras, radius, carrier in view, carrier masked, gain, noise, pose error, primitives, exposure, and
sums of poses and depth, and of pictures and masks."""


def test_a_seed_means_what_it_meant_when_the_weights_that_ship_were_trained():
    shares = {**VALUES["kind"], "terrain": 0.0, "ruins": 0.0, "plain": 0.0, "lit": 0.0}
    world = random_rigs(1, values={**VALUES, "kind": shares}).world
    for seed, known in KNOWN.items():
        frame = world.frame(seed)
        rig, faults, scene = frame.true_rig, frame.faults, frame.scene
        carried = bool(frame.free), bool(frame.rig.masks)
        drawn = len(rig), float(rig.radius), *carried, frame.gain, faults.noise, faults.pose_error
        found = frame.kind, *drawn, len(scene.primitives), scene.exposure.item()
        assert found[0] == known[0]
        assert found[1:] == pytest.approx(known[1:-2], abs=1e-4, rel=1e-3)
        depth = frame.inverse_depth(Icosphere(2).vertices)
        masks = (mask[None].float() for mask in frame.rig.masks.values())
        geometry = weighted_sum(frame.rig.world_from_camera, depth)
        assert geometry == pytest.approx(known[-2], abs=0.002)
        assert coarse_sum(*frame.images.values(), *masks) == pytest.approx(known[-1], abs=0.02)


def test_what_is_drawn_for_one_purpose_changes_nothing_of_another():
    purposes = ("kind", "sky", "rig", "carrier", "clutter", "faults", "brightness")
    streams = [getattr(Draws.of(seed), purpose).initial_seed() for seed in range(200) for purpose in purposes]
    assert len(set(streams)) == len(streams)
    plain = random_rigs(1).world
    for changed in ({"kind": {"room": 1.0}}, {"level_rigs": 1.0}, {"carrier": 0.0}, {"clutter": 1.0}):
        world = random_rigs(1, values={**VALUES, **changed}).world
        for seed in range(8):
            one, other = plain.frame(seed), world.frame(seed)
            assert (one.faults, one.gain) == (other.faults, other.gain)
            assert (one.kind == other.kind) or "kind" in changed
            poses = one.true_rig.world_from_camera, other.true_rig.world_from_camera
            assert torch.equal(*poses) or "level_rigs" in changed


def test_points_nearer_than_the_nearest_hypothesis_are_not_valid():
    """Of a pole that counts as depth: all of it, or what is nearest of it."""
    rig = ring_rig(3, image_size=(24, 24))
    for nearest in (0.55, 0.2):
        sample = world_scenes(rig, 1, 3, SampleView(3, 3), min_depth=nearest, carrier="pole")[0]
        depth = 1 / sample["inverse_depth"]
        assert (depth < nearest).any()
        assert torch.equal(sample["valid"], depth >= nearest)


def test_masks_hide_carriers_from_what_was_seen_and_from_nothing_else():
    values = {**VALUES, "carrier": 1.0}
    hidden, shown, none = (
        random_rigs(6, 50, values={**values, **changed})
        for changed in ({"masked": 1.0}, {"masked": 0.0}, {"carrier": 0.0})
    )
    for index in range(6):
        with_masks, without, free = hidden[index], shown[index], none[index]
        assert torch.equal(without["seen"], free["seen"])
        behind = free["seen"] & ~with_masks["seen"]
        assert 0.005 < behind.sum() / free["seen"].sum() < 0.5
        assert not (with_masks["seen"] & ~free["seen"]).any()
        assert (with_masks["images"].movedim(1, -1)[behind] == 0).all()
        assert not (without["images"].movedim(1, -1)[behind] == 0).all()
        assert not with_masks["rig"].masks
