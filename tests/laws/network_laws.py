# SPDX-License-Identifier: Apache-2.0
"""What must hold for every depth network, written once.

A network is one line in ``NETWORKS``, and gets every law below. A law takes an ``Example`` and fails with an assertion.
"""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.core import ArgumentError, ArgumentTypeError, ShapeError
from sphericalvision.icosphere import num_icosphere_vertices
from sphericalvision.losses import depth_index_huber
from sphericalvision.models import (
    DepthNetwork,
    IcoSweepNet,
    OmniMVS,
    RefinedSweepNet,
    RomniStereo,
    SemiGlobalSweep,
    WinnerTakesAll,
    load_weights,
    save_weights,
)
from sphericalvision.sweep import DepthHint

IMAGE_SIZE = (24, 30)
TOLERANCE = 1e-4
"""Of a hypothesis: what the order of sums in single precision may change."""


@dataclass(frozen=True)
class Example:
    """A network to be tested.

    Attributes:
        make: the network, in the least size that is whole.
        changes: hyper-parameters that may be changed after training, with other values.
        shaped: one on which the shapes of the weights depend, with another value.
    """

    make: Callable[[], DepthNetwork]
    changes: dict[str, Any]
    shaped: dict[str, Any]

    def net(self) -> DepthNetwork:
        """The network with random weights, which are the same every time, in eval mode."""
        net = self.make()
        net.load_state_dict(self.state)
        return net.eval()

    @cached_property
    def state(self) -> dict[str, Tensor]:
        """Weights, and statistics other than those of a new network, so that it tells hypotheses apart."""
        torch.manual_seed(0)
        net = self.make()
        with torch.no_grad():
            for part in net.modules():
                if isinstance(part, torch.nn.modules.batchnorm._BatchNorm):
                    part.momentum = 1.0
            net.train()(*inputs(net, 2, seed=1))
        return net.state_dict()


SMALL = {"feature_channels": 2, "num_cameras": 3}
PANORAMA = SMALL | {"output_size": (8, 16), "in_channels": 3, "num_scales": 2}

REFINED_PRIOR = {"norm": "instance", "aggregation": "variance", "feature_coarsening": 1, "volume_channels": 2}


def trained(net: DepthNetwork) -> DepthNetwork:
    """The network with noise in the layers that begin at zero, which would hide what comes before them."""
    with torch.no_grad():
        for parameter in net.parameters():
            if not parameter.any():
                parameter.normal_(std=0.1)
    return net


def moving(net: RomniStereo) -> RomniStereo:
    """The network with steps of more than a hypothesis, which a new one does not make."""
    with torch.no_grad():
        net.update.step[1].weight.mul_(100)
        net.update.step[1].bias.fill_(4)
    return net


NETWORKS = {
    "icosweepnet": Example(
        lambda: IcoSweepNet(3, 4, **SMALL), {"level": 4, "min_depth": 0.3}, {"feature_channels": 3}
    ),
    "icosweepnet on variance": Example(
        lambda: IcoSweepNet(3, 4, **SMALL, norm="instance", aggregation="variance", feature_coarsening=1),
        {"level": 2, "num_hypotheses": 6},
        {"volume_channels": 3},
    ),
    "omnimvs": Example(
        lambda: OmniMVS(8, **PANORAMA), {"min_depth": 0.3, "output_size": (16, 32)}, {"num_scales": 3}
    ),
    "omnimvs on variance, within latitudes": Example(
        lambda: OmniMVS(
            8, **PANORAMA | {"output_size": (8, 32)}, norm="instance", aggregation="variance", circular=True
        ),
        {"num_hypotheses": 16},
        {"in_channels": 1},
    ),
    "refinedsweepnet": Example(
        lambda: trained(
            RefinedSweepNet(
                3,
                6,
                inner_hypotheses=5,
                widths=(4, 4),
                blocks=1,
                prior=REFINED_PRIOR | {"feature_channels": 2},
            )
        ),
        {"level": 4, "num_hypotheses": 9, "min_depth": 0.3},
        {"widths": (4, 6)},
    ),
    "romnistereo": Example(
        lambda: moving(RomniStereo(16, feature_channels=2, output_size=(8, 16), in_channels=3, iterations=2)),
        {"min_depth": 0.3, "output_size": (16, 32), "iterations": 3},
        {"feature_channels": 3},
    ),
    "romnistereo, normalised by sample, within latitudes": Example(
        lambda: moving(
            RomniStereo(16, feature_channels=2, output_size=(8, 32), norm="instance", iterations=1)
        ),
        {"num_hypotheses": 20},
        {"in_channels": 3},
    ),
    "semi-global sweep": Example(
        lambda: SemiGlobalSweep(3, 8, depth_coarsening=1), {"level": 4, "num_hypotheses": 6}, {}
    ),
    "winner takes all": Example(lambda: WinnerTakesAll(3, 8), {"min_depth": 0.3}, {}),
}
"""Every network of the package, and every form that differs in more than its size."""


def inputs(
    net: DepthNetwork, batch: int, num_cameras: int | None = None, seed: int = 0
) -> tuple[Tensor, CameraRig]:
    """Images of noise that a network takes, and a rig of as many cameras as it is for."""
    count = num_cameras or (3 if net.any_cameras else net.num_cameras)
    size = (num_icosphere_vertices(net.level),) if net.images == "sphere" else IMAGE_SIZE
    noise = torch.rand(batch, count, 3, *size, generator=torch.Generator().manual_seed(seed))
    return 2 * noise - 1, ring_rig(count, image_size=IMAGE_SIZE)


def law_answers_lie_on_the_grid_and_in_range(example: Example) -> None:
    net = example.net()
    index, confidence, seen = net.predict(*inputs(net, 2))
    assert index.shape == confidence.shape == seen.shape == (2, *net.grid.shape)
    assert index.min() >= 0
    assert index.max() <= net.num_hypotheses - 1
    assert index.std() > 1e-3, "an example whose index is the same everywhere tests nothing"
    assert confidence.min() >= 0
    assert confidence.max() <= 1 + 1e-6
    assert seen.dtype == torch.bool
    assert torch.equal(net(*inputs(net, 2)), index)
    depth = net.depth(index)
    torch.testing.assert_close(depth.amin(), net.depth(index.amax()))
    assert depth.min() >= net.min_depth * (1 - 1e-6)


def law_hyperparameters_rebuild_the_network(example: Example) -> None:
    net = example.net()
    again = type(net)(**net.hyperparameters)
    assert again.hyperparameters == net.hyperparameters
    assert {name: tensor.shape for name, tensor in again.state_dict().items()} == {
        name: tensor.shape for name, tensor in net.state_dict().items()
    }
    again.load_state_dict(net.state_dict())
    assert torch.equal(again.eval()(*inputs(net, 1)), net(*inputs(net, 1)))


def law_state_holds_what_was_learned_alone(example: Example) -> None:
    """Tables and grids are made anew, so that weights fit any level."""
    net = example.net()
    statistics = ("running_mean", "running_var", "num_batches_tracked")
    learned = {name for name, _ in net.named_parameters()}
    assert {name for name in net.state_dict() if not name.endswith(statistics)} == learned


def law_files_and_copies_give_the_same_answers(example: Example, folder: Path) -> None:
    net = example.net()
    expected = net(*inputs(net, 1))
    loaded = load_weights(save_weights(net, folder / "net.safetensors"))
    assert type(loaded) is type(net)
    assert not loaded.training
    for again in (loaded, copy.deepcopy(net), pickle.loads(pickle.dumps(net))):
        assert again.hyperparameters == loaded.hyperparameters
        assert torch.equal(again(*inputs(net, 1)), expected)


def law_a_batch_is_its_samples(example: Example) -> None:
    net = example.net()
    images, rig = inputs(net, 2)
    larger = ring_rig(len(rig), radius=0.3, image_size=IMAGE_SIZE)
    rigs = CameraRig.stack([rig, larger])
    together = net.predict(images, rigs)
    for sample, alone in enumerate((rig, larger)):
        one = net.predict(images[sample : sample + 1], alone)
        for both, single in zip(together, one, strict=True):
            torch.testing.assert_close(both[sample], single[0], rtol=0, atol=TOLERANCE)
    assert (net(images, rig)[1] - together.index[1]).abs().max() > TOLERANCE, "the rig ought to matter"


def law_tables_stand_for_the_rig(example: Example) -> None:
    net = example.net()
    images, rig = inputs(net, 2)
    for made in (rig, CameraRig.stack([rig, rig])):
        tables = net.tables(made)
        for one, other in zip(net.predict(images, tables), net.predict(images, made), strict=True):
            assert torch.equal(one, other)


def law_cameras_in_any_order_and_number(example: Example) -> None:
    net = example.net()
    images, rig = inputs(net, 1)
    order = torch.arange(len(rig)).roll(1).tolist()
    if not net.any_cameras:
        with pytest.raises(ShapeError, match="images"):
            net(*inputs(net, 1, len(rig) + 1))
        return
    permuted = net.predict(images[:, order], rig.permuted(order))
    for one, other in zip(permuted, net.predict(images, rig), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=TOLERANCE)
    for count in (2, len(rig) + 2):
        assert net(*inputs(net, 1, count)).shape == (1, *net.grid.shape)


def law_all_weights_learn_and_recomputing_changes_nothing(example: Example) -> None:
    """Neither gradients nor statistics."""
    net, results = example.net().train(), []
    images, rig = inputs(net, 2)
    index = net(images, rig)
    target = (net.num_hypotheses - 1) * torch.rand(index.shape, generator=torch.Generator().manual_seed(1))
    # A hint that is trusted teaches the gate for hints.
    hint = DepthHint(net.depth(index).reciprocal(), torch.ones_like(index)) if net.takes_hints else None
    for recompute in (False, True) if example.state else ():
        net.load_state_dict(example.state)
        net.configure(recompute=recompute).zero_grad()
        torch.manual_seed(0)  # of the order of cameras
        with torch.enable_grad():
            net.training_loss(images, rig, None, target, target > 1, depth_index_huber, hint).backward()
        gradients = {name: parameter.grad for name, parameter in net.named_parameters()}
        results.append((gradients, {name: buffer.clone() for name, buffer in net.named_buffers()}))
        if net.hyperparameters.get("iterations") != 1:  # of an index that is 0 before it
            assert all(gradient.isfinite().all() and gradient.any() for gradient in gradients.values())
    torch.testing.assert_close(results[:1], results[1:], rtol=1e-4, atol=1e-5)


def law_hints_are_taken_or_refused(example: Example) -> None:
    """One of weight 0 says nothing, to the bit; the network's own answer makes it surer."""
    net = example.net()
    images, rig = inputs(net, 2)
    size = (2, *net.grid.shape)
    hint = DepthHint(net.depth(net(images, rig)).reciprocal(), torch.zeros(size))
    if not net.takes_hints:
        with pytest.raises(ArgumentError, match=f"hint: {type(net).__name__} takes none"):
            net(images, rig, hint=hint)
        return
    for one, other in zip(net.predict(images, rig, hint=hint), net.predict(images, rig), strict=True):
        assert torch.equal(one, other)
    assert not torch.equal(net(images, rig, hint=hint._replace(weight=torch.ones(size))), net(images, rig))
    with pytest.raises(ShapeError, match=r"hint\.weight: expected shape"):
        net(images, rig, hint=hint._replace(weight=hint.weight[:1]))
    with pytest.raises(ArgumentTypeError, match="hint: expected a DepthHint"):
        net(images, rig, hint=hint.weight)


def law_what_was_not_seen_is_told(example: Example) -> None:
    """A point is seen where two cameras see it, and never where the images show nothing."""
    net = example.net()
    images, rig = inputs(net, 2)
    shape = (len(rig), *images.shape[3:])
    everything, nothing = torch.ones(shape, dtype=torch.bool), torch.zeros(shape, dtype=torch.bool)
    whole = net.predict(images, rig, everything)
    assert whole.seen.float().mean() > 0.5
    assert not net.predict(images, rig, nothing).seen.any()
    one_camera = nothing.clone()
    one_camera[0] = True
    assert not net.predict(images, rig, one_camera).seen.any()
    half = torch.stack((everything, nothing))  # a mask a sample
    first, second = net.predict(images, rig, half).seen
    assert torch.equal(first, whole.seen[0])
    assert not second.any()
    with pytest.raises(ShapeError, match="seen"):
        net(images, rig, everything[:, :-1])


def law_zero_is_a_colour(example: Example) -> None:
    """Mid-grey pixels are 0, and were seen."""
    net = example.net()
    images, rig = inputs(net, 1)
    seen = torch.ones(len(rig), *images.shape[3:], dtype=torch.bool)
    grey = torch.zeros_like(images)
    assert torch.equal(net.predict(grey, rig, seen).seen.any(), net.predict(images, rig, seen).seen.any())
    assert net.predict(grey, rig, seen).seen.any()


def law_changes_keep_the_weights(example: Example) -> None:
    net = example.net()
    changed = net.with_changes(**example.changes)
    assert net.hyperparameters | {
        k: list(v) if isinstance(v, tuple) else v for k, v in example.changes.items()
    } == (changed.hyperparameters)
    assert all(torch.equal(changed.state_dict()[name], value) for name, value in net.state_dict().items())
    assert changed(*inputs(changed, 1)).shape == (1, *changed.grid.shape)
    assert changed.training == net.training
    same = net.with_changes(**dict.fromkeys(example.changes))
    assert torch.equal(same(*inputs(net, 1)), net(*inputs(net, 1)))
    assert same.double().with_changes().state_dict().keys() == net.state_dict().keys()
    assert {p.dtype for p in same.with_changes().parameters()} <= {torch.float64}
    if example.shaped:
        with pytest.raises(ArgumentError, match="cannot be changed after training"):
            net.with_changes(**example.shaped)


def law_index_at_the_grids_own_directions_is_the_index(example: Example) -> None:
    net = example.net()
    index = net(*inputs(net, 2))
    directions = net.grid.directions.reshape(-1, 3)
    values, reached = net.index_at(index, directions)
    assert reached.all()
    torch.testing.assert_close(values, index.flatten(1), rtol=0, atol=1e-3)


def law_images_of_another_shape_are_refused(example: Example) -> None:
    net = example.net()
    images, rig = inputs(net, 1)
    for wrong in (images[0], images[:, :, :2], images[..., :-1]):
        with pytest.raises(ShapeError, match="images"):
            net(wrong, rig)


LAWS = [law for name, law in sorted(globals().items()) if name.startswith("law_")]
