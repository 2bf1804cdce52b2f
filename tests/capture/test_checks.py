# SPDX-License-Identifier: Apache-2.0
"""Warnings about captures: each comes when its fault is there, and none without."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from sphericalvision import Predictor
from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import Depth
from sphericalvision.capture.checks import (
    DISAGREES,
    PhotoConsistency,
    camera_agreement,
    capture_warnings,
    hypotheses_warning,
    pose_agreement,
)
from sphericalvision.scenes import make_scene, render_rig

RING = ring_rig(4, image_size=(80, 80))


def scattered(seed: int) -> CameraRig:
    """Cameras of a ring, each tilted and moved by a little of its own: inverted, they are still apart."""
    generator = torch.Generator().manual_seed(seed)
    poses = RING.rotated(tilt=0.5 * torch.rand(4, generator=generator)).world_from_camera.clone()
    poses[:, :3, 3] += 0.2 * torch.rand(4, 3, generator=generator)
    return CameraRig(RING.cameras, poses)


def depth_of(rig: CameraRig, kind: str, min_depth: float, taken_with: CameraRig | None = None) -> Depth:
    images = render_rig(make_scene(kind, seed=3), rig if taken_with is None else taken_with)
    return Predictor(rig, method="semi_global", level=5, min_depth=min_depth)(images)


@pytest.mark.parametrize("kind", ["room", "hall"])
def test_a_good_capture_needs_no_words(kind: str) -> None:
    assert capture_warnings(depth_of(scattered(1), kind, 0.55)) == []


def test_little_overlap_is_told() -> None:
    (warning,) = capture_warnings(depth_of(RING.subset([0, 2]), "room", 0.55))
    assert "Two cameras see" in warning
    assert 10 < int(warning.split("see ")[1].split(" %")[0]) < 50


def test_wasted_hypotheses_are_told() -> None:
    depth = depth_of(RING, "hall", 0.1)
    assert ["min_depth = 0.10 m" in warning for warning in capture_warnings(depth)] == [True]
    guessed = torch.arange(len(depth.index)) % 9 == 0  # to be near
    index, confidence = depth.index.where(~guessed, 15.0), depth.confidence.where(~guessed, 0.0)
    assert hypotheses_warning(replace(depth, index=index, confidence=confidence)) is not None


def test_a_rig_of_hundreds_of_metres_is_told_by_its_radius() -> None:
    poses = RING.world_from_camera.clone()
    poses[:, :3, 3] *= 1000  # in millimetres
    depth = depth_of(CameraRig(RING.cameras, poses), "room", 100.0, taken_with=RING)
    assert ["200 m from their centre" in sentence for sentence in capture_warnings(depth)].count(True) == 1
    assert not any("wasted" in sentence for sentence in capture_warnings(depth))


def test_twelve_bits_in_sixteen_are_told() -> None:
    depth = depth_of(RING, "room", 0.55)
    dark = {name: image / 16 for name, image in depth.images.items()}
    (warning,) = capture_warnings(replace(depth, images=dark))
    assert "12 bits" in warning


def test_one_picture_of_two_cameras_is_told() -> None:
    depth = depth_of(RING, "room", 0.55)
    spoiled = {**depth.images, "cam2": depth.images["cam3"]}
    assert any("cam2 and cam3 are one picture" in s for s in capture_warnings(replace(depth, images=spoiled)))


@pytest.mark.parametrize("seed", [1, 2])
def test_inverted_poses_are_told(seed: int) -> None:
    rig = scattered(seed)
    inverted = CameraRig(rig.cameras, rig.camera_from_world)
    warnings = capture_warnings(depth_of(inverted, "room", 0.55, taken_with=rig))
    assert any("camera-from-world" in warning for warning in warnings)
    images = render_rig(make_scene("room", seed=3), rig)
    assert pose_agreement(images, rig) > 2 * pose_agreement(images, inverted)


def test_what_a_mask_hides_has_no_part_in_the_agreement_of_cameras() -> None:
    mask = torch.arange(80).expand(80, 80) < 40
    depth = depth_of(RING.replaced(masks={"cam1": mask}), "room", 0.55)
    spoiled = {**depth.images, "cam1": depth.images["cam1"].where(mask, 1.0)}
    clean, other = (camera_agreement(replace(depth, images=images)) for images in (depth.images, spoiled))
    assert other == pytest.approx(clean, abs=0.03)
    assert min(clean.values()) > DISAGREES
    white = replace(depth, images={**depth.images, "cam1": torch.ones(3, 80, 80)})
    assert any("there: cam1" in sentence for sentence in capture_warnings(white))


def test_photo_consistency_falls_with_wrong_depth() -> None:
    judge, depth = PhotoConsistency(level=4), depth_of(RING, "room", 0.55)
    share = judge(depth)
    assert 0.7 < share < 1
    assert judge(replace(depth, index=15 - depth.index)) < share - 0.2
    assert judge(replace(depth, rig=RING.rotated(tilt=0.1))) < share - 0.1  # another rig has other tables
