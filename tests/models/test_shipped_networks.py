# SPDX-License-Identifier: Apache-2.0
"""The networks that ship, on a rendered room: what was seen is told, and not guessed from colours."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.data import ToSphere
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import DepthNetwork, pretrained
from sphericalvision.scenes import make_scene, ray_depth, render_rig
from sphericalvision.sphere.intake import pixels_seen
from sphericalvision.sweep import index_from_depth

Room = tuple[CameraRig, Mapping[str, Tensor]]


@pytest.fixture(scope="module")
def room() -> Room:
    """A rig with a mask on one camera, and what it sees of a room; nothing in it is exactly mid-grey."""
    rig = ring_rig(4, radius=0.2, image_size=(64, 64))
    mask = torch.ones(64, 64, dtype=torch.bool)
    mask[40:] = False
    rig = CameraRig(rig.cameras, rig.world_from_camera, masks={"cam2": mask})
    photographs = render_rig(make_scene("room", seed=3), rig)
    return rig, {name: image.where(image != 0.5, 0.501) for name, image in photographs.items()}


def prepared(net: DepthNetwork, room: Room) -> tuple[Tensor, Tensor]:
    """Images as the network wants them, and where they show something."""
    rig, photographs = room
    if net.images == "sphere":
        to_sphere = ToSphere(net.level)
        return to_sphere.images(photographs, rig)[None], to_sphere.seen(rig)
    seen = torch.stack(list(pixels_seen(rig).values()))
    images = torch.stack([2 * photographs[name] - 1 for name in rig.names])
    return images.where(seen[:, None], 0.0)[None], seen


@torch.no_grad()
@pytest.mark.parametrize("name", ["icosweepnet-small", "icosweepnet-study", "omnimvs-study"])
def test_zero_outside_says_the_same_as_what_was_seen(name: str, room: Room) -> None:
    """The networks were trained with zeros standing for what was not seen: where nothing else is 0, both agree."""
    net = pretrained(name)
    if net.images == "sphere":
        net = net.with_changes(level=5)
    images, seen = prepared(net, room)
    nonzero = (images != 0).any(2)
    assert torch.equal(nonzero, seen.expand_as(nonzero))
    index, confidence, points_seen = net.predict(images, room[0], seen)
    for told, guessed in zip(
        (index, confidence, points_seen), net.predict(images, room[0], nonzero), strict=True
    ):
        assert torch.equal(told, guessed)
    unmasked = net.predict(images, room[0])
    assert (unmasked.index - index).abs().max() > 0.1, "the mask ought to matter"
    assert points_seen.sum() < unmasked.seen.sum()


@torch.no_grad()
@pytest.mark.parametrize("name", ["icosweepnet-small", "omnimvs-study"])
def test_a_grey_patch_counts_as_seen(name: str, room: Room) -> None:
    """A wall of 0, exactly mid-grey, is as much seen as one a shade lighter."""
    net = pretrained(name)
    images, seen = prepared(net, room)
    patch = torch.zeros_like(seen)
    patch[0, ..., : patch.shape[-1] // 3] = True
    results = [
        net.predict(images.where(~(patch & seen)[:, None], shade), room[0], seen) for shade in (0.0, 1e-6)
    ]
    torch.testing.assert_close(results[0].index, results[1].index, rtol=0, atol=1e-3)
    assert torch.equal(results[0].seen, results[1].seen)


@torch.no_grad()
def test_the_refined_network_knows_masks_and_rooms(room: Room) -> None:
    """Masks of the rig count without being passed, a grey wall is seen, and depth is near the truth."""
    net = pretrained("refinedsweepnet").with_changes(level=5)
    images, seen = prepared(net, room)
    index, confidence, both = net.predict(images, room[0])
    assert torch.equal(index, net.predict(images, room[0], seen).index)
    unmasked = net.predict(images, ring_rig(4, radius=0.2, image_size=(64, 64)))
    assert both.sum() < unmasked.seen.sum()
    patch = torch.zeros_like(seen)
    patch[0, : patch.shape[-1] // 3] = True
    grey = net.predict(images.where(~(patch & seen)[:, None], 0.0), room[0], seen)
    assert (grey.seen == both).float().mean() > 0.97
    depth = ray_depth(make_scene("room", seed=3), room[0].center, Icosphere(5).vertices)
    error = (index[0] - index_from_depth(depth, net.num_hypotheses, net.min_depth)).abs()
    assert error[both[0]].median() < 0.6
    sure = confidence[0] > 0.8
    assert 0.3 < sure.float().mean() < 1
    assert error[sure].mean() < 0.7 * error[~sure].mean()
