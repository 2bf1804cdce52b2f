# SPDX-License-Identifier: Apache-2.0
"""Training in batches of samples whose rigs differ."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from itertools import islice
from typing import Any

import pytest
import torch

from sphericalvision.cameras import CameraRig, EquirectangularCamera, ring_rig
from sphericalvision.core import ArgumentError
from sphericalvision.data import collate_samples
from sphericalvision.losses import depth_index_huber
from sphericalvision.models import (
    DepthNetwork,
    IcoSweepNet,
    OmniMVS,
    RefinedSweepNet,
    RomniStereo,
    SemiGlobalSweep,
)
from sphericalvision.models.refinedsweepnet import PRIOR
from sphericalvision.recipes.datamodules.data_module import TrainingBatches, TrainingStream
from sphericalvision.recipes.datamodules.random_rigs import RandomRigDataModule
from sphericalvision.recipes.training.depth_module import DepthModule
from sphericalvision.recipes.training.rig_tables import RigTables, _tensors, stacked_tables
from tests.documented import ROOT
from tests.processes import python
from tests.worlds import RANDOM_RIGS

SIZE = (24, 48)
LEVELS: Any = {3: {"seeds": (0, 4), "times": 1, "batch_size": 1, "image_size": (16, 16)}}


def refined(train_prior: bool = False) -> RefinedSweepNet:
    prior = IcoSweepNet(3, 16, num_cameras=2, **PRIOR)
    return RefinedSweepNet.around(
        prior, train_prior, level=3, widths=(4, 4), blocks=1, inner_hypotheses=8, num_hypotheses=8
    )


NETWORKS: dict[str, Callable[[], DepthNetwork]] = {
    "icosweepnet": partial(IcoSweepNet, 3, 4, 0.5, 4, 3, norm="instance", aggregation="variance"),
    "omnimvs": partial(
        OmniMVS, 8, 0.5, 2, 3, (8, 16), 3, norm="instance", aggregation="variance", num_scales=2
    ),
    "refinedsweepnet": refined,
    "refinedsweepnet, with its prior": partial(refined, True),
}


def three_rigs() -> list[CameraRig]:
    """Level and tilted fisheyes, and panoramas."""
    ring = ring_rig(3, 0.2, SIZE)
    panoramas = [EquirectangularCamera(SIZE)] * 3
    return [
        ring.to(dtype=torch.float64),
        ring_rig(3, 0.1, SIZE).rotated(tilt=0.3).to(dtype=torch.float64),
        CameraRig(panoramas, ring.world_from_camera).to(dtype=torch.float64),
    ]


def samples_of(net: DepthNetwork, generator: torch.Generator) -> list[dict[str, Any]]:
    """Random images of three cameras and random depth, known at more places in one sample than in another."""
    on_sphere = net.images == "sphere"
    size = (10 * 4**net.level + 2,) if on_sphere else SIZE
    images, truth, valid = (
        ("images", "inverse_depth", "valid")
        if on_sphere
        else ("fisheye", "panorama_inverse_depth", "panorama_valid")
    )
    grid: Any = net.grid
    return [
        {
            images: 2 * torch.rand(3, 3, *size, generator=generator).double() - 1,
            truth: torch.rand(grid.shape, generator=generator).double(),
            valid: torch.rand(grid.shape, generator=generator) < share,
            "seen" if on_sphere else "fisheye_seen": torch.rand(3, *size, generator=generator) < 0.95,
            "rig": rig,
        }
        for rig, share in zip(three_rigs(), (0.9, 0.5, 0.1), strict=True)
    ]


def module_of(net: DepthNetwork, hints: float = 0.0, compile: str | None = None) -> DepthModule:
    """A module that logs nothing; hints are drawn for each sample."""
    module = DepthModule(
        net, depth_index_huber, torch.optim.SGD, lambda optimizer: optimizer, hints=hints, compile=compile
    )
    module.log = lambda *_, **__: None  # type: ignore[method-assign,assignment]
    return module


@pytest.mark.parametrize("name", NETWORKS)
def test_loss_and_gradients_of_a_batch_are_the_mean_of_its_samples(
    name: str, generator: torch.Generator
) -> None:
    torch.manual_seed(0)
    net = NETWORKS[name]().double().train()
    module = module_of(net)
    samples = samples_of(net, generator)
    results = []
    for batches in ([[sample] for sample in samples], [samples]):
        net.zero_grad()
        losses = [module.training_step(collate_samples(batch), 0) for batch in batches]
        loss = torch.stack(losses).mean()
        loss.backward()
        gradients = {key: value.grad for key, value in net.named_parameters() if value.grad is not None}
        results.append((loss.detach(), gradients))
    (one_by_one, expected), (together, gradients) = results
    torch.testing.assert_close(together, one_by_one, rtol=1e-9, atol=0)
    assert set(gradients) == set(expected)
    for key, gradient in gradients.items():
        torch.testing.assert_close(gradient, expected[key], rtol=1e-6, atol=1e-9, msg=key)


def compile_step(name: str) -> None:
    """Compile the step of a network, and compare loss and gradients."""
    torch.manual_seed(0)
    net = NETWORKS[name]().double().train()
    batch = collate_samples(samples_of(net, torch.Generator().manual_seed(0)))
    results = []
    for backend in (None, "aot_eager"):
        net.zero_grad()
        loss = module_of(net, compile=backend).training_step(batch, 0)
        loss.backward()
        results.append([loss, *(value.grad for value in net.parameters() if value.grad is not None)])
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] == 1
    assert not torch._dynamo.utils.counters["graph_break"]


@pytest.mark.slow  # tests/models/test_one_graph.py says of every network that it never asks the host
@pytest.mark.parametrize("name", ["omnimvs", "icosweepnet", "refinedsweepnet"])
def test_a_compiled_step_is_one_graph_and_the_same(name: str) -> None:
    """In a process of its own: what compares calls with their annotations here is not for compilers."""
    python("-c", f"from tests.recipes import test_batches; test_batches.compile_step({name!r})", path=ROOT)


def test_a_backend_is_what_torch_compiles_with_or_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "compile", lambda function, backend: backend)
    assert module_of(refined(), compile="eager").training_loss == "eager"
    with pytest.raises(ArgumentError, match=r"task\.compile.*inductor"):
        module_of(refined(), compile="faster")


@pytest.mark.parametrize("name", NETWORKS)
def test_bfloat16_is_of_layers_alone(name: str, generator: torch.Generator) -> None:
    """Tables are made in full precision within a step, and the loss is that of full precision but for rounding."""
    torch.manual_seed(0)
    net = NETWORKS[name]().train()
    samples = samples_of(net, generator)
    batch = collate_samples(
        [
            {
                key: value.to(dtype=torch.float32)
                if isinstance(value, CameraRig) or value.is_floating_point()
                else value
                for key, value in sample.items()
            }
            for sample in samples
        ]
    )
    expected = module_of(net).training_step(batch, 0)
    module = module_of(net)
    with torch.autocast("cpu", torch.bfloat16):
        loss = module.training_step(batch, 0)
        rounded = module.tables.of(batch["rig"])
    assert loss.dtype == torch.float32
    torch.testing.assert_close(loss, expected, rtol=0.02, atol=0)
    assert _tensors(rounded)
    for one, other in zip(_tensors(rounded), _tensors(RigTables(net).of(batch["rig"])), strict=True):
        assert torch.equal(one, other)


def test_tables_of_a_batch_are_those_of_its_rigs() -> None:
    """Of rigs that are new made in one go, of others one by one."""
    net, rigs = refined(), [ring_rig(2, radius, SIZE) for radius in (0.1, 0.2, 0.3)]
    tables = RigTables(net)
    for batch in (CameraRig.stack(rigs), CameraRig.stack(rigs), rigs):
        singles = zip(*(_tensors(net.tables(rig)) for rig in rigs), strict=True)
        for together, alone in zip(_tensors(tables.of(batch)), singles, strict=True):
            assert torch.equal(together, torch.stack(alone))
    same = [ring_rig(2, 0.4, SIZE) for _ in range(2)]
    assert tables.of(CameraRig.stack(same)) is tables.of(same) is tables.of(same[0])


def test_images_of_two_sizes_are_no_batch() -> None:
    net = OmniMVS(8, feature_channels=2, num_cameras=2, output_size=(8, 16), num_scales=2)
    sizes = [net.tables(ring_rig(2, image_size=size)) for size in ((32, 40), (32, 48))]
    with pytest.raises(ArgumentError, match="one size"):
        stacked_tables(sizes)


class Numbers(torch.utils.data.Dataset[dict[str, Any]]):
    """Samples that are their index and a random number."""

    def __init__(self, count: int) -> None:
        self.count = count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> dict[str, Any]:
        return {"index": index, "noise": torch.rand(())}


@pytest.mark.parametrize(("world", "groups", "size"), [(1, 3, 2), (3, 3, 2), (2, 1, 1), (4, 1, 3)])
def test_batches_hold_one_group_and_leave_nothing_out(world: int, groups: int, size: int) -> None:
    stream = TrainingStream(Numbers(7), seed=2)

    def batches(length: int, start: int = 0, rank: int = 0, world: int = 1) -> list[list[int]]:
        return list(TrainingBatches(stream, size, length, lambda index: index % groups, start, rank, world))

    whole = batches(60)
    for batch in whole:
        assert len({stream.index_at(position) % groups for position in batch}) == 1
    positions = [position for batch in whole for position in batch]
    assert len(set(positions)) == len(positions)
    # Of each group a batch less one sample waits at most.
    assert set(range(len(positions) - groups * (size - 1))) <= set(positions)
    # Processes take batches of one group at a time, and together those of one process.
    steps = list(zip(*(batches(60, rank=rank, world=world) for rank in range(world)), strict=True))
    for step in steps:
        assert len({stream.index_at(positions[0]) % groups for positions in step}) == 1
    taken = [batch for step in steps for batch in step]
    assert len({tuple(batch) for batch in taken}) == len(taken)
    known = batches(60 * world)
    assert len([batch for batch in known if batch not in taken]) <= (groups - 1) * (world - 1)
    assert groups > 1 or taken == known
    shares = [batches(10, 2 * world, rank, world) for rank in range(world)]
    assert list(zip(*shares, strict=True)) == steps[2:12]


@pytest.mark.parametrize(
    ("make", "numbers"),
    [
        (partial(OmniMVS, 8, 0.55, 2, 3, (20, 40), 3, aggregation="variance", num_scales=2), [2, 5]),
        (partial(RomniStereo, 16, 0.55, 2, (10, 20), 3, iterations=1), [4]),
    ],
    ids=["omnimvs", "romnistereo"],
)
def test_networks_on_panoramas_learn_from_random_rigs(
    make: Callable[[], DepthNetwork], numbers: list[int]
) -> None:
    options: dict[str, Any] = {"world": {**RANDOM_RIGS, "level_rigs": 0.0}, "image_size": (32, 32)}
    data = RandomRigDataModule(num_train=6, batch_size=2, num_cameras=numbers, **options)
    net = make()
    data.bind_network(net)
    module = module_of(net)
    for batch in islice(data.train_dataloader(), 2):
        assert batch["fisheye"].shape[1] in numbers
        assert batch["rig"].positions.shape[:2] == batch["fisheye"].shape[:2]
        module.training_step(batch, 0).backward()
    gradients = torch.cat([p.grad.flatten() for p in net.parameters() if p.grad is not None])
    assert gradients.isfinite().all()
    assert gradients.abs().max() > 0
    assert data.loader(data.dataset("val")).batch_size == 1
    with pytest.raises(ArgumentError, match=r"data\.levels: expected none for"):
        RandomRigDataModule(levels=LEVELS, num_cameras=numbers, **options).bind_network(net)


def test_rigs_of_other_numbers_of_cameras_are_refused() -> None:
    data = RandomRigDataModule(world=RANDOM_RIGS)
    with pytest.raises(ArgumentError, match=r"RomniStereo takes rigs of 4 .* data.num_cameras=\[4\]"):
        data.bind_network(RomniStereo(16, 0.55, 2, (10, 20)))


def test_tables_are_those_of_the_rig_and_made_once() -> None:
    net = IcoSweepNet(level=3, num_hypotheses=4, min_depth=0.5, feature_channels=2, num_cameras=2)
    tables = RigTables(net, capacity=2)
    rigs = [ring_rig(2), ring_rig(2, radius=0.201), ring_rig(2, field_of_view=math.pi)]
    first = tables.of(rigs[0])
    for rig in rigs:
        for mine, fresh in zip(tables.of(rig), net.tables(rig), strict=True):
            assert torch.equal(mine, fresh)
    assert tables.of(rigs[2]) is tables.of(ring_rig(2, field_of_view=math.pi))
    assert tables.of(rigs[0]) is not first  # the oldest made room


def test_tables_within_tables_count_against_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of a sweep without training hold those of the sphere sweep."""
    monkeypatch.setattr("sphericalvision.recipes.training.rig_tables.BYTES", 1)
    tables = RigTables(SemiGlobalSweep(level=3, num_hypotheses=4))
    first = tables.of(ring_rig(2))
    tables.of(ring_rig(3))  # too heavy to stay beside the first
    assert tables.of(ring_rig(2)) is not first
