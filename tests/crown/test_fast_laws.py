# SPDX-License-Identifier: Apache-2.0
"""Every operator and network of the crown by layers in torch, by operators in C++, and by the readable formulas."""

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from sphericalvision.cameras import ring_rig
from sphericalvision.crown import (
    CrownBatchNorm2d,
    CrownBatchNorm3d,
    CrownBlock3d,
    CrownConv2d,
    CrownConv3d,
    CrownConvNorm2d,
    CrownConvNorm3d,
    CrownExchange,
    CrownInstanceNorm2d,
    CrownInstanceNorm3d,
    FromCrown,
    HexConv2d,
    HexConv3d,
    ToCrown,
    crown_block3d,
    recompute,
    set_kernel_options,
    to_crown,
)
from sphericalvision.crown.fast import cpp
from sphericalvision.kernels import kernels
from sphericalvision.models import IcoSweepNet
from sphericalvision.models.icosweepnet import CostRegularizer, FeatureExtractor
from tests.crown.compiler import needs_compiler
from tests.laws.fast_laws import (
    FastCase,
    law_gradients_agree,
    law_gradients_of_gradients_agree,
    law_modes_agree,
    law_values_agree,
)


class Head(nn.Module):
    """A normalised convolution and one without, from vertices to vertices."""

    def __init__(self, norm: str) -> None:
        super().__init__()
        self.first = CrownConvNorm3d(3, 4, norm, relu=True)
        self.second = CrownConv3d(4, 1)

    def forward(self, volume: Tensor) -> Tensor:
        return crown_block3d(volume, self.first, self.second)


class Network(nn.Module):
    """The whole network on random images."""

    def __init__(self, **options: Any) -> None:
        super().__init__()
        self.net = IcoSweepNet(3, 4, feature_channels=3, num_cameras=2, shuffle_cameras=False, **options)
        self.rig = ring_rig(2)

    def forward(self, images: Tensor) -> Tensor:
        return self.net(images, self.rig.to(images.dtype))


def between(*layers: nn.Module) -> nn.Module:
    """Layers on crowns, from vertices to vertices."""
    return nn.Sequential(ToCrown(), *layers, FromCrown())


def recomputing(module: nn.Module) -> nn.Module:
    set_kernel_options(module, recompute=True)
    return module


def case(name: str, make: Any, *shape: int) -> FastCase:
    return FastCase(name, make, shape)


V0, V1, V2, V3 = 12, 42, 162, 642

OPERATORS = [
    case("unfold and fold", lambda: nn.Sequential(ToCrown(), FromCrown()), 3, V2),
    case("exchange of volumes", lambda: between(CrownExchange()), 3, 2, V1),
    case("conv2d, level 0", lambda: between(CrownConv2d(3, 4, bias=True)), 3, V0),
    case("conv2d, level 1", lambda: between(CrownConv2d(3, 4)), 3, V1),
    case("conv2d, level 2", lambda: between(CrownConv2d(3, 4)), 3, V2),
    case("conv2d, stride 2", lambda: between(CrownConv2d(3, 4, 2)), 3, V1),
    case("conv3d, level 0, N = 1", lambda: between(CrownConv3d(2, 3, bias=True)), 2, 1, V0),
    case("conv3d, level 1, N = 3", lambda: between(CrownConv3d(2, 3)), 2, 3, V1),
    case("conv3d, level 1, N = 6", lambda: between(CrownConv3d(2, 3, bias=True)), 2, 6, V1),
    case("conv3d, level 2, N = 4", lambda: between(CrownConv3d(2, 3)), 2, 4, V2),
    case("conv3d, stride 2", lambda: between(CrownConv3d(2, 3, 2)), 2, 4, V1),
    case("hexconv2d", lambda: HexConv2d(3, 4, bias=True), 3, V1),
    case("hexconv2d, level 0", lambda: HexConv2d(3, 4), 3, V0),
    case("hexconv2d, level 3, stride 2", lambda: HexConv2d(3, 4, 2, bias=True), 3, V3),
    case("hexconv2d, north, level 0", lambda: HexConv2d(3, 4, orientation="north", level=0), 3, V0),
    case("hexconv2d, north, stride 2", lambda: HexConv2d(3, 4, 2, orientation="north", level=1), 3, V1),
    case("hexconv3d", lambda: HexConv3d(2, 3, bias=True), 2, 3, V1),
    case("batch norm 2d", lambda: between(CrownBatchNorm2d(3)), 3, V1),
    case("batch norm 3d", lambda: between(CrownBatchNorm3d(3)), 3, 2, V1),
    case("instance norm 2d", lambda: between(CrownInstanceNorm2d(3)), 3, V1),
    case("instance norm 3d", lambda: between(CrownInstanceNorm3d(3)), 3, 2, V1),
    case("conv, batch norm, relu 2d", lambda: between(CrownConvNorm2d(3, 4, relu=True)), 3, V1),
    case("conv, instance norm 2d, stride 2", lambda: between(CrownConvNorm2d(3, 4, 2, "instance")), 3, V1),
    case("conv, batch norm 3d", lambda: between(CrownConvNorm3d(2, 3)), 2, 3, V1),
    case("conv, instance norm, relu 3d", lambda: between(CrownConvNorm3d(2, 3, "instance", True)), 2, 4, V1),
    case("block, batch norm, level 0", lambda: CrownBlock3d(2, 3, 2), 2, 8, V0),
    case("block, batch norm, residual", lambda: CrownBlock3d(3, 4, 3, residual=True), 3, 4, V1),
    case("block, instance norm, residual", lambda: CrownBlock3d(2, 3, 2, "instance", True), 2, 5, V1),
    case("block, instance norm, level 2", lambda: CrownBlock3d(2, 3, 4, "instance"), 2, 4, V2),
    case("block, batch norm, recomputed", lambda: recomputing(CrownBlock3d(2, 3, 2)), 2, 4, V1),
    case("head, batch norm", lambda: Head("batch"), 3, 6, V1),
    case("head, instance norm", lambda: Head("instance"), 3, 4, V1),
    case("conv2d, level 3, 20 channels", lambda: between(CrownConv2d(20, 18)), 20, V3),
    case("conv3d, N = 8, 33 channels", lambda: between(CrownConv3d(33, 16)), 33, 8, V2),
    case("hexconv2d, north, 17 channels", lambda: HexConv2d(3, 17, orientation="north", level=1), 3, V1),
    case("conv, batch norm 3d, 18 channels", lambda: between(CrownConvNorm3d(2, 18)), 2, 4, V1),
]

NETWORKS = [
    case("features, batch norm", lambda: FeatureExtractor(3), 3, V2),
    case("features, instance norm, coarsening 1", lambda: FeatureExtractor(3, 3, "instance", 1), 3, V2),
    case("features, recomputed", lambda: recomputing(FeatureExtractor(3)), 3, V2),
    case("regulariser, batch norm", lambda: CostRegularizer(4, 2), 4, 4, V1),
    case("regulariser, instance norm", lambda: CostRegularizer(4, 2, "instance", 3), 4, 5, V1),
    case("regulariser, recomputed", lambda: recomputing(CostRegularizer(4, 2)), 4, 4, V0),
    case("network, concatenation", Network, 2, 3, V3),
    case("network, variance", lambda: Network(aggregation="variance", norm="instance"), 2, 3, V3),
]

WAYS = ["plain", "graph", pytest.param("require", marks=needs_compiler)]
by_each_way = pytest.mark.parametrize("way", WAYS)


def each(cases: list[FastCase]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("case", cases, ids=[case.name for case in cases])


@by_each_way
@each(OPERATORS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("training", [False, True])
def test_values(case: FastCase, way: str, dtype: torch.dtype, training: bool) -> None:
    law_values_agree(case, 2, dtype, training, way)


@by_each_way
@each(NETWORKS)
@pytest.mark.parametrize(("dtype", "training"), [(torch.float32, False), (torch.float64, True)])
def test_values_of_networks(case: FastCase, way: str, dtype: torch.dtype, training: bool) -> None:
    law_values_agree(case, 2, dtype, training, way)


@by_each_way
@each(OPERATORS)
@pytest.mark.parametrize("batch", [1, 3])
def test_values_of_any_batch(case: FastCase, way: str, batch: int) -> None:
    law_values_agree(case, batch, torch.float32, training=True, way=way)


@by_each_way
@each([case for case in OPERATORS if "norm" not in case.name])
def test_an_empty_batch(case: FastCase, way: str) -> None:
    law_values_agree(case, 0, torch.float32, training=False, way=way)


@by_each_way
@each(OPERATORS)
@pytest.mark.parametrize("training", [False, True])
def test_gradients(case: FastCase, way: str, training: bool) -> None:
    law_gradients_agree(case, 2, training, way)


@by_each_way
@each(NETWORKS)
def test_gradients_of_networks(case: FastCase, way: str) -> None:
    law_gradients_agree(case, 2, training=True, way=way)


@needs_compiler
@each([case for case in NETWORKS if "features" in case.name])
def test_what_is_forgotten_changes_nothing(case: FastCase, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recompute, "LARGE", 1)
    law_values_agree(case, 2, torch.float64, training=True, way="require")
    law_gradients_agree(case, 2, training=True, way="require")


@by_each_way
@each(OPERATORS)
def test_gradients_of_gradients(case: FastCase, way: str) -> None:
    law_gradients_of_gradients_agree(case, 2, training=True, way=way)


@by_each_way
@each(OPERATORS + NETWORKS)
def test_modes(case: FastCase, way: str) -> None:
    law_modes_agree(case, 2, way)


@needs_compiler
@each([case for case in OPERATORS if case.name == "block, batch norm, residual"])
def test_operators_compile(case: FastCase) -> None:
    """Into one graph, by what they say of shapes; a backend that runs it as it is."""
    function = case.function(torch.float32)
    inputs = case.inputs(1, torch.float32).requires_grad_()
    with kernels("require"):
        expected = function(inputs)
        result = torch.compile(function, backend="aot_eager", fullgraph=True)(inputs)
        wanted, found = (torch.autograd.grad(x.square().sum(), inputs)[0] for x in (expected, result))
    torch.testing.assert_close(result, expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(found, wanted, rtol=1e-3, atol=1e-4)


@needs_compiler
@pytest.mark.parametrize("norm", ["batch", "instance"])
def test_training_keeps_what_is_given_to_a_block_and_to_its_normalisations(norm: str) -> None:
    """Neither crowns that values can be laid out as once more, nor what was normalised and rectified."""
    block, values = CrownBlock3d(16, 16, 16, norm), torch.randn(1, 16, 8, V2, requires_grad=True)
    kept: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    with kernels("require"), torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        block(values)
    small = [4 * x.numel() for x in block.parameters()]
    crown = sum(x.nbytes for x in to_crown(values))
    assert sum(kept.values()) < values.nbytes + 2 * crown + 2 * sum(small)


@needs_compiler
def test_training_keeps_nothing_inside_the_finest_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a ``FeatureExtractor`` on large crowns: as many tensors however many blocks there are."""
    monkeypatch.setattr(recompute, "LARGE", 1)
    images, kept = torch.randn(1, 3, V2, requires_grad=True), []
    for blocks in (1, 3):
        features, sizes = FeatureExtractor(4), list[int]()

        def keep(tensor: Tensor, sizes: list[int] = sizes) -> Tensor:
            sizes.append(tensor.nbytes)
            return tensor

        features.fine = features.fine[:blocks]
        with kernels("require"), torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            features(images)
        kept.append(sizes)
    assert kept[0] == kept[1]


@by_each_way
@each([case("features", lambda: FeatureExtractor(3, 3, "instance"), 3, V2)])
def test_transforms_of_functions(case: FastCase, way: str) -> None:
    """``torch.func.grad`` through strides, too, which knows no hooks of saved tensors."""
    function, inputs = case.function(torch.float64), case.inputs(1, torch.float64)

    def loss(values: Tensor) -> Tensor:
        return function(values).square().sum()

    with kernels("reference"):
        wanted = torch.func.grad(loss)(inputs)
    with kernels(way):
        torch.testing.assert_close(torch.func.grad(loss)(inputs), wanted)


@each(NETWORKS)
def test_operators_are_left_alone_unless_asked_for(case: FastCase, monkeypatch: pytest.MonkeyPatch) -> None:
    def entered(*_: Any) -> None:
        raise AssertionError

    monkeypatch.setattr(cpp, "hex_convolution", entered)
    monkeypatch.setattr(cpp, "crown_normalization", entered)
    function, inputs = case.function(torch.float32), case.inputs(1, torch.float32).requires_grad_()
    for way in ("reference", "plain"):
        with kernels(way):
            function(inputs).square().sum().backward()
