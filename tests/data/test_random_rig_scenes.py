# SPDX-License-Identifier: Apache-2.0
"""Samples through random rigs: each follows from its seed alone."""

from __future__ import annotations

from collections import Counter

import pytest
import torch

from sphericalvision.core import ArgumentError
from sphericalvision.data.random_rig_scenes import SHARES, RandomRigScenes
from sphericalvision.data.scenes.recipes import make_scene, ray_depth
from sphericalvision.data.seeded_scenes import HELD_OUT_SEED
from sphericalvision.icosphere import Icosphere

SMALL = {"level": 3, "image_size": (24, 24)}


def equal(one, other):
    return all(torch.equal(one[key], other[key]) for key in ("images", "seen", "inverse_depth", "valid"))


def test_a_seed_is_a_sample_with_a_cache_and_without(tmp_path):
    plain, kept = RandomRigScenes(4, 7, **SMALL), RandomRigScenes(4, 7, **SMALL, cache_dir=tmp_path)
    for index in range(4):
        first, second = kept[index], kept[index]
        assert equal(first, second)
        assert equal(first, plain[index])
        assert torch.equal(first["rig"].world_from_camera, plain[index]["rig"].world_from_camera)
    assert equal(RandomRigScenes(1, 9, **SMALL)[0], plain[2])
    assert RandomRigScenes(1, **SMALL).name != RandomRigScenes(1, **SMALL, disturbed=0.0).name


def test_samples_are_what_they_say():
    scenes = RandomRigScenes(6, 20, **SMALL, disturbed=0.0)
    for sample in (scenes[index] for index in range(6)):
        assert sample["images"].shape == (len(sample["rig"]), 3, 642)
        assert (sample["images"].movedim(1, -1)[~sample["seen"]] == 0).all()
        kind, _, seed = sample["frame"].rpartition("-")
        depth = ray_depth(make_scene(kind, int(seed)), sample["rig"].center, Icosphere(3).vertices)
        torch.testing.assert_close(sample["inverse_depth"], depth.reciprocal())


def test_rigs_and_scenes_are_of_all_kinds():
    scenes = RandomRigScenes(300, **SMALL)
    kinds = Counter(scenes.frame(seed).rpartition("-")[0] for seed in range(300))
    assert set(kinds) == set(SHARES)
    assert all(abs(kinds[kind] / 300 - share) < 0.08 for kind, share in SHARES.items())
    rigs = [scenes.true_rig(seed) for seed in range(60)]
    assert {len(rig) for rig in rigs} == {2, 3, 4, 5, 6}
    off = [not torch.equal(scenes.rig(k).world_from_camera, rigs[k].world_from_camera) for k in range(60)]
    assert 0.1 < sum(off) / 60 < 0.6


def test_seeds_of_the_benchmark_and_unknown_kinds_are_refused():
    with pytest.raises(ArgumentError, match="seeds"):
        RandomRigScenes(2, HELD_OUT_SEED - 1, **SMALL)
    with pytest.raises(ArgumentError, match="shares"):
        RandomRigScenes(1, shares={"forest": 1.0}, **SMALL)
