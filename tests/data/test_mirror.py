# SPDX-License-Identifier: Apache-2.0
"""Mirrored samples are what the mirrored rig would have seen of the mirrored world."""

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.data.augmentation.fivefold import Mirror, mirror_ids
from sphericalvision.icosphere import Icosphere
from sphericalvision.scenes.random_rigs import random_rig
from sphericalvision.sweep import semi_global_costs, semi_global_tables


@pytest.mark.parametrize("level", [0, 1, 4])
def test_the_icosphere_is_its_own_mirror_image(level: int) -> None:
    vertices, ids = Icosphere(level, dtype=torch.float64).vertices, mirror_ids(level)
    assert torch.equal(ids[ids], torch.arange(len(ids)))
    exchanged = vertices[ids] * vertices.new_tensor([-1, 1, 1])
    torch.testing.assert_close(exchanged, vertices, rtol=0, atol=1e-12)


def test_the_mirrored_rig_sees_the_mirrored_world() -> None:
    generator = torch.Generator().manual_seed(1)
    rig = random_rig(generator, (3,), image_size=(64, 64), panoramas=0.0)
    images = torch.rand(3, 3, 2562, generator=generator) * 2 - 1
    seen, evidence = what_the_sweep_sees(images, rig)
    sample = {"images": images, "seen": seen, "rig": rig}
    mirrored = Mirror()(sample)
    seen_then, evidence_then = what_the_sweep_sees(mirrored["images"], mirrored["rig"])
    assert (seen_then == mirrored["seen"]).float().mean() > 0.999
    assert ((evidence_then - evidence[..., mirror_ids(3)]).abs() < 1e-3).float().mean() > 0.99
    assert ((evidence_then - evidence).abs() > 0.1).float().mean() > 0.2  # it is another picture
    assert torch.equal(Mirror()(mirrored)["images"], images)


def test_the_centre_is_mirrored() -> None:
    rig, origin = ring_rig(3), torch.tensor([4e5, 0.0, 5e6]).double()
    off_centre = CameraRig(rig.cameras, rig.world_from_camera, around=["cam2"], origin=origin)
    mirrored = Mirror()({"valid": torch.arange(12), "rig": off_centre})["rig"]
    exchange = torch.tensor([-1.0, 1.0, 1.0])
    assert torch.equal(mirrored.center, off_centre.center * exchange)
    assert torch.equal(mirrored.in_world().center, off_centre.in_world().center * exchange.double())


def what_the_sweep_sees(images: Tensor, rig: CameraRig) -> tuple[Tensor, Tensor]:
    """Fields of view ``(n, V)``, and mean and best correlation and numbers of cameras, before any smoothing."""
    tables = semi_global_tables(rig, 8, 0.5, 4)
    evidence, _ = semi_global_costs(images[None], tables.sweep, tables.seen[None])
    return tables.seen, evidence[0]


def test_a_share_of_samples_follows_its_generator() -> None:
    sample = {"valid": torch.arange(12), "rig": ring_rig(2)}
    sometimes = Mirror(0.5, torch.Generator().manual_seed(0))
    stayed = [sometimes(sample) is sample for _ in range(40)]
    assert 8 < sum(stayed) < 32
