# SPDX-License-Identifier: Apache-2.0
"""A forward pass through tables is one graph of few operators, none of which waits for the host, wherever it runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

from sphericalvision.cameras import ring_rig
from sphericalvision.capture.graphs import NoWaiting
from sphericalvision.icosphere import num_icosphere_vertices
from sphericalvision.kernels import kernels
from sphericalvision.models import DepthNetwork, IcoSweepNet, OmniMVS, pretrained
from tests.processes import python

ROOT = Path(__file__).parents[2]

WAITS = ("aten.nonzero", "aten._local_scalar_dense", "aten.item", "aten.unique", "aten.masked_select")
FROM_NUMBERS = ("aten.lift_fresh", "aten.scalar_tensor")
NO_LAUNCH = ("aten._unsafe_view", "aten.empty", "aten.new_empty")
"""Memory alone, or another view of it."""


class Operators(TorchDispatchMode):
    """Counts what a device would be asked for, what it would be waited for, and tensors made of numbers of Python."""

    def __init__(self) -> None:
        super().__init__()
        self.launches, self.waits, self.from_numbers = 0, Counter[str](), Counter[str]()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = str(func)
        self.launches += not (func.is_view or name.startswith(NO_LAUNCH))
        self.waits[name] += name.startswith(WAITS)
        self.from_numbers[name] += name.startswith(FROM_NUMBERS)
        return func(*args, **(kwargs or {}))


def sample(net: DepthNetwork, batch: int = 1) -> tuple[torch.Tensor, Any]:
    """Images and tables of a rig for a network."""
    rig = ring_rig(net.num_cameras if not net.any_cameras else 4, image_size=(32, 32))
    if net.images == "sphere":
        shape: tuple[int, ...] = (3, num_icosphere_vertices(net.image_level))
    else:
        shape = (net.image_channels[0], 32, 32)
    images = torch.rand(batch, len(rig), *shape, generator=torch.Generator().manual_seed(0))
    return images * 2 - 1, net.tables(rig)


SHIPPED: dict[str, tuple[Callable[[], DepthNetwork], int]] = {
    "refinedsweepnet": (pretrained, 1780),
    "refinedsweepnet, level 5": (lambda: pretrained().at_level(5), 1524),
    "icosweepnet-small": (lambda: pretrained("icosweepnet-small"), 411),
    "the paper's": (lambda: IcoSweepNet(4, 32, feature_channels=4), 464),
    "omnimvs": (lambda: OmniMVS(8, feature_channels=2, output_size=(16, 64)), 156),
}
"""Network, and operators without views that a forward pass asks for at most: the same at any level, but for the
sweep's smoothing, and for any width."""


@pytest.mark.parametrize("name", SHIPPED)
@torch.inference_mode()
def test_a_forward_pass_is_few_operators_without_a_word_to_the_host(
    name: str, record_property: Callable[[str, object], None]
) -> None:
    make, most = SHIPPED[name]
    net = make().eval()
    images, tables = sample(net)
    expected = net(images, tables)
    with kernels("graph"):
        index = net(images, tables)  # makes the tables of icospheres, once
        with Operators() as counted:
            net(images, tables)
    print(f"{name}: {counted.launches} operators a forward pass")  # the table of operators: pytest -s
    record_property("operators", counted.launches)
    assert counted.launches <= most
    assert not +counted.waits
    assert not +counted.from_numbers
    # Where a vertex is undecided between two surfaces rounding decides.
    assert (index - expected).abs().mean() < 2e-3


class OneDevice(NoWaiting):
    """Refuses to be waited for, copies between host and device, and tensors of the host among those of the device."""

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
        if any(not tensor.is_meta for tensor in tensors):
            raise RuntimeError(f"{function} takes a tensor of the host, which the device has to be sent")
        return super().__torch_dispatch__(function, types, args, kwargs)


@pytest.mark.parametrize("name", SHIPPED)
@torch.inference_mode()
def test_a_forward_pass_sends_a_device_nothing(name: str) -> None:
    """Everything is on the meta device, which is no host either."""
    make, _ = SHIPPED[name]
    net = make().eval()
    images, tables = tree_map_only(torch.Tensor, lambda tensor: tensor.to("meta"), sample(net))
    net.to("meta")
    net(images, tables)  # makes the tables of icospheres, once
    with OneDevice():
        assert net(images, tables).is_meta
    with OneDevice(), pytest.raises(RuntimeError, match="takes a tensor of the host"):
        net(images + torch.zeros(1), tables)


COMPILED = """
import torch
from tests.laws.network_laws import NETWORKS, inputs

net = NETWORKS[{name!r}].net()
images, rig = inputs(net, 2)
tables = net.tables(rig)
with torch.no_grad():
    compiled = torch.compile(net, fullgraph=True, backend="aot_eager")(images, tables)
    torch.testing.assert_close(compiled, net(images, tables), rtol=1e-4, atol=1e-4)
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["icosweepnet", "refinedsweepnet", "omnimvs", "romnistereo"])
def test_it_compiles_as_one_graph(name: str) -> None:
    """In a process of its own: what compares calls with their annotations here is not for compilers."""
    python("-c", COMPILED.format(name=name), path=ROOT)
