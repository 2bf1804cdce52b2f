# SPDX-License-Identifier: Apache-2.0
"""Scenes seen by cameras whose tilt is drawn for each: what studies train with, so that tilts are no surprise."""

import math
from pathlib import Path

import pytest
import torch

from sphericalvision.cameras import CameraRig
from sphericalvision.data import SampleView
from sphericalvision.scenes import make_scene, render_rig
from tests.worlds import scenes

TILTS = (math.radians(-15), math.radians(45))


def test_each_scene_has_a_tilt_of_its_own_and_the_same_depth(rig: CameraRig) -> None:
    tilted, level = (scenes(rig, 3, 5, tilts=tilts) for tilts in (TILTS, None))
    looks = [[math.degrees(math.asin(axis[1])) for axis in tilted[k]["rig"].axes] for k in range(3)]
    assert all(-23 <= angle <= 53 for angles in looks for angle in angles)
    assert all(max(angles) - min(angles) <= 16 for angles in looks)
    assert abs(looks[0][0] - looks[1][0]) > 1
    assert abs(looks[1][0] - looks[2][0]) > 1
    for k in range(3):
        assert torch.equal(tilted[k]["inverse_depth"], level[k]["inverse_depth"])
        assert torch.equal(tilted[k]["rig"].positions, rig.positions)
        assert not torch.equal(tilted[k]["seen"], level[k]["seen"])


def test_tilts_are_all_between_the_least_and_the_largest(rig: CameraRig) -> None:
    world = scenes(rig, tilts=TILTS).world
    looks = torch.stack([world.frame(seed).true_rig.axes[:, 1].asin().mean() for seed in range(300)])
    middle, width = sum(TILTS) / 2, TILTS[1] - TILTS[0]
    assert looks.mean().item() == pytest.approx(middle, abs=width / 15)
    assert looks.std().item() == pytest.approx(width / math.sqrt(12), rel=0.15)


def test_images_are_taken_by_the_tilted_cameras(tmp_path: Path, rig: CameraRig) -> None:
    """From the cache, too, where each scene has another rig; cameras' images and those on the sphere alike."""
    view = SampleView(3, 1, images=True)
    tilted = scenes(rig, 2, view=view, tilts=TILTS, cache_dir=tmp_path)
    for _ in range(2):
        sample = tilted[1]
        pictures = render_rig(make_scene("room", 1, center=rig.center), sample["rig"])
        expected = torch.stack(list(pictures.values())) * 2 - 1
        seen = sample["fisheye_seen"][:, None]
        assert ((sample["fisheye"] - expected) * seen).abs().max() <= 0.51 / 127.5
    assert len(list(tmp_path.iterdir())) == 1
    other = scenes(rig, 2, view=view, cache_dir=tmp_path)
    assert not torch.equal(other[1]["fisheye"], sample["fisheye"])
