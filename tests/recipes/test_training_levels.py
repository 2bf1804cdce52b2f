# SPDX-License-Identifier: Apache-2.0
"""One set of weights for several levels: networks that share weights, samples of several levels, and batches again."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from typing import Any

import torch

from sphericalvision.data import collate_samples
from sphericalvision.models import IcoSweepNet, RefinedSweepNet
from sphericalvision.models.refinedsweepnet import PRIOR
from sphericalvision.recipes.datamodules.data_module import TrainingStream
from sphericalvision.recipes.datamodules.random_rigs import LevelSamples, RandomRigDataModule
from sphericalvision.scenes.draws import Draws
from tests.recipes.test_batches import module_of
from tests.worlds import RANDOM_RIGS

LEVELS: dict[int, LevelSamples] = {
    3: {"seeds": (0, 90), "times": 2, "batch_size": 3, "image_size": (16, 16)},
    4: {"seeds": (100, 60), "times": 1, "batch_size": 2, "image_size": (24, 24)},
    5: {"seeds": (200, 30), "times": 1, "batch_size": 1, "image_size": (32, 32)},
}


def network(level: int = 4) -> RefinedSweepNet:
    torch.manual_seed(0)
    return RefinedSweepNet(
        level, widths=(4, 4), blocks=1, coarse_level=3, prior={**PRIOR, "feature_channels": 4}
    )


def data_of(net: RefinedSweepNet, **options: Any) -> RandomRigDataModule:
    data = RandomRigDataModule(
        world=RANDOM_RIGS, image_size=(24, 24), num_train=200, batch_size=2, levels=LEVELS, **options
    )
    data.bind_network(net)
    return data


def test_a_network_at_another_level_learns_with_the_first() -> None:
    net = network()
    other = net.at_level(5)
    assert (other.level, other.coarse_level, net.level) == (5, 3, 4)
    with torch.no_grad():
        next(iter(net.refinement.parameters())).add_(1)
    for one, same in zip(net.parameters(), other.parameters(), strict=True):
        assert one is same
    normed = IcoSweepNet(3, feature_channels=2, num_cameras=2)
    buffers = dict(normed.at_level(4).named_buffers())
    assert all(
        value is buffers[name] for name, value in normed.named_buffers() if name in normed.state_dict()
    )


def test_batches_are_of_one_level_and_number_of_cameras_and_all_come() -> None:
    data = data_of(network())
    assert data.plain("val").view == replace(data.view, antialias=True)  # images are finer than the sphere
    loader = data.train_dataloader()
    stream, counts, numbers = loader.dataset, dict.fromkeys(LEVELS, 0), set()
    assert isinstance(stream, TrainingStream)
    for positions in islice(loader.batch_sampler or (), 60):
        ((level, number, _),) = {data.group(stream.index_at(position)) for position in positions}
        assert level is not None
        assert len(positions) == LEVELS[level]["batch_size"]
        counts[level] += 1
        numbers.add(number)
    assert len(numbers) > 1
    assert min(counts[3], counts[4], counts[5]) > 5  # 60, 30 and 30 in a round
    assert counts[3] > max(counts[4], counts[5])


def test_groups_are_those_of_the_rigs() -> None:
    """What is drawn of a rig quickly is what the rig has."""
    data = data_of(network())
    for index in range(40):
        _, number, panoramic = data.group(index)
        rig = data.rigs((24, 24))(Draws.of(index).rig)  # the first 90 are of seeds 0 to 89
        cameras = list(rig.cameras.values())
        assert (number, panoramic) == (len(cameras), "Equirectangular" in type(cameras[0]).__name__)


def test_every_level_trains_the_same_weights() -> None:
    net = network()
    module, data = module_of(net, hints=0.35), data_of(net)
    seen = set()
    for batch in islice(data.train_dataloader(), 8):
        assert batch["images"].dtype == torch.uint8
        net.zero_grad()
        loss = module.training_step(batch, 0)
        loss.backward()
        assert loss.isfinite()
        assert all(value.grad is not None and value.grad.isfinite().all() for value in net.parameters())
        assert next(iter(net.prior.parameters())).grad.abs().sum() > 0  # type: ignore[union-attr]
        seen.add(batch["images"].shape[-1])
        if len(seen) == 3:
            return
    raise AssertionError(f"batches of {seen} vertices alone")


def test_a_batch_that_is_turned_is_the_same_world() -> None:
    net = network()
    data = data_of(net)
    batch = collate_samples([data.plain("train")[index] for index in same_group(data)])
    changed = data.augmentation(torch.Generator().manual_seed(0))(batch)
    assert changed["images"].shape == batch["images"].shape
    module = module_of(net)
    for part in ("images", "inverse_depth"):
        assert torch.equal(changed[part].sort(-1).values, batch[part].sort(-1).values)
    torch.testing.assert_close(
        module.training_step(changed, 0), module.training_step(batch, 0), rtol=0.2, atol=0
    )


def same_group(data: RandomRigDataModule) -> list[int]:
    first = data.group(0)
    return [index for index in range(100) if data.group(index) == first][:2]
