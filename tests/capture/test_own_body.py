# SPDX-License-Identifier: Apache-2.0
"""The body that carries a rig, found where pictures of a moving world stand still."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import find_own_body
from sphericalvision.capture.preparation import own_body

SIZE, WIDTH = 96, 112
RIG = ring_rig(2, image_size=(SIZE, WIDTH))
Images = dict[str, Tensor]


def world(seed: int) -> Images:
    """Blobs, other ones in every frame and camera."""
    drawn = np.random.default_rng(seed)
    blobs = {name: cv2.GaussianBlur(drawn.random((SIZE, WIDTH)), (0, 0), SIZE / 32) for name in RIG.names}
    return {
        name: torch.from_numpy(2 * (image - 0.5) + 0.5).float().clamp(0, 1).expand(3, -1, -1)
        for name, image in blobs.items()
    }


def with_body(images: Images) -> Images:
    """A dark plate at the bottom of the first camera."""
    first = images["cam1"].clone()
    first[:, BODY] = 0.1
    return {**images, "cam1": first}


BODY = torch.zeros(SIZE, WIDTH, dtype=torch.bool)
BODY[66:, 26:86] = True
SEEN = RIG.cameras["cam1"].unproject(RIG.cameras["cam1"].pixel_grid()).valid


def test_a_plate_is_found_and_nothing_else() -> None:
    found = find_own_body(RIG, (with_body(world(seed)) for seed in range(12)))
    hidden = ~found.masks["cam1"] & SEEN
    assert (hidden & BODY).sum() > 0.95 * (BODY & SEEN).sum()
    assert (hidden & BODY).sum() > 0.7 * hidden.sum()
    assert found.masks["cam2"].all()
    assert found.shares["cam1"] == pytest.approx(hidden.sum().item() / SEEN.sum().item(), abs=0.01)
    assert found.shares["cam2"] == 0
    assert (found.num_views, found.reason) == (12, "")
    assert CameraRig(RIG.cameras, RIG.world_from_camera, found.masks).masks


def test_exposure_and_noise_change_little() -> None:
    def taken(seed: int) -> Images:
        drawn = torch.Generator().manual_seed(seed)
        gain = 0.7 + 0.5 * torch.rand((), generator=drawn)
        return {
            name: (gain * image + 0.02 * torch.randn(image.shape, generator=drawn)).clamp(0, 1)
            for name, image in with_body(world(seed)).items()
        }

    hidden = ~find_own_body(RIG, map(taken, range(20))).masks["cam1"] & SEEN
    assert (hidden & BODY).sum() > 0.9 * (BODY & SEEN).sum()
    assert (hidden & BODY).sum() > 0.65 * hidden.sum()


def test_noise_is_estimated_as_what_gradients_of_smooth_noise_deviate_by() -> None:
    view = own_body._CameraEdges(RIG, "cam1")
    frames = np.random.default_rng(0).normal(0.5, 0.03, (40, SIZE, WIDTH)).astype(np.float32)
    gradients = own_body._gradients([cv2.GaussianBlur(f, (0, 0), own_body.SMOOTH) for f in frames])
    deviation = np.hypot(*gradients).mean(0)[view.inside].mean()
    assert view._noise(frames) == pytest.approx(deviation, rel=0.1)


def test_a_world_without_a_body_is_left_free() -> None:
    found = find_own_body(RIG, map(world, range(12)))
    assert all(mask.all() for mask in found.masks.values())
    assert found.reason == "no body was seen"


@pytest.mark.parametrize("seeds", [[0] * 12, [0, 1, 2, 3], [0] * 6 + [1] * 6])
def test_a_rig_that_stands_still_has_no_body(seeds: list[int]) -> None:
    found = find_own_body(RIG, [with_body(world(seed)) for seed in seeds])
    assert all(mask.all() for mask in found.masks.values())
    assert "the rig must move" in found.reason
    assert found.num_views == len(set(seeds))


def test_what_two_cameras_see_far_away_is_no_body() -> None:
    """A plate in the same place of all frames is none of the rig if both cameras see it in the same direction."""
    poses = RIG.world_from_camera[:1].expand(2, -1, -1).clone()
    poses[1, 0, 3] += 0.1  # beside one another, looking the same way
    rig = CameraRig(RIG.cameras, poses)
    both, one = [], []
    for seed in range(12):
        images = with_body(world(seed))
        one.append(images)
        both.append({**images, "cam2": images["cam1"]})
    assert find_own_body(rig, one).shares["cam1"] > 0.1
    assert find_own_body(rig, both).shares["cam1"] == 0


def test_masks_before_remain_and_hide_what_they_hide() -> None:
    before = torch.ones(SIZE, WIDTH, dtype=torch.bool)
    before[58:] = False
    rig = CameraRig(RIG.cameras, RIG.world_from_camera, {"cam1": before})
    found = find_own_body(rig, [with_body(world(seed)) for seed in range(12)])
    assert torch.equal(found.masks["cam1"], before)
    assert found.shares["cam1"] == 0


def test_large_images_are_looked_at_in_a_small_size() -> None:
    factor = 4
    size = (factor * SIZE, factor * WIDTH)
    large = RIG.resized(size)
    frames = [with_body(world(seed)) for seed in range(12)]
    up = [
        {n: torch.nn.functional.interpolate(i[None], size, mode="nearest")[0] for n, i in f.items()}
        for f in frames
    ]
    hidden = ~find_own_body(large, up).masks["cam1"][factor // 2 :: factor, factor // 2 :: factor] & SEEN
    assert hidden.shape == BODY.shape
    assert (hidden & BODY).sum() > 0.9 * (BODY & SEEN).sum()
    assert (hidden & BODY).sum() > 0.65 * hidden.sum()


def test_of_many_frames_a_spread_is_kept() -> None:
    assert 25 <= find_own_body(RIG, map(world, range(130))).num_views <= 50
