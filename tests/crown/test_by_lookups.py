# SPDX-License-Identifier: Apache-2.0
"""Few large operators give the numbers of the others."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from sphericalvision.crown import Crown, CrownBatchNorm3d, CrownBlock3d, from_crown, hex_conv2d, to_crown
from sphericalvision.crown.hexconv import north_fraction
from sphericalvision.crown.norm import crown_norm
from sphericalvision.icosphere import icosphere_vertices
from sphericalvision.kernels import kernels, prefer_fused
from sphericalvision.tables import constant_table, copied


def compare(function: Callable[[], Tensor]) -> None:
    expected = function()
    with kernels("graph"):
        found = function()
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_where_few_large_operators_are() -> None:
    cpu, other = torch.device("cpu"), torch.device("meta")
    assert [prefer_fused(device) for device in (cpu, other)] == [False, True]
    with kernels("graph"):
        assert prefer_fused(cpu)
    with kernels("reference"):
        assert not prefer_fused(other)


def test_tables_are_made_once_and_stay_what_they_are() -> None:
    calls = []

    def table(size: int, device: torch.device | None = None) -> Tensor:
        calls.append(size)
        return torch.arange(float(size), device=device)

    constant = constant_table(table)
    with torch.inference_mode():
        first = constant(3)
    assert constant(3) is first
    assert not first.is_inference()  # of use where gradients are wanted
    assert constant(3, torch.device("meta")).is_meta
    with pytest.raises(TypeError):
        constant([3])  # type: ignore[arg-type]
    assert calls == [3, 3, [3]]
    copied(constant)(3).zero_()
    assert constant(3).sum() == 3
    vertices = icosphere_vertices(1)
    vertices.zero_()
    assert icosphere_vertices(1).any()


@pytest.mark.parametrize("level", [0, 1, 3])
@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("oriented", [True, False])
def test_hexagonal_convolutions(level: int, stride: int, bias: bool, oriented: bool) -> None:
    if stride > 1 and level == 0:
        return
    torch.manual_seed(0)
    values, weight = torch.randn(2, 3, 10 * 4**level + 2), torch.randn(5, 3, 7)
    north = north_fraction(level) if oriented else None
    compare(lambda: hex_conv2d(values, weight, torch.arange(5.0) if bias else None, stride, north))


def random_crown(level: int, *middle: int) -> Crown:
    n = 2**level
    return Crown(torch.randn(2, 5, *middle, 2 * n + 1, n + 1), torch.randn(2, 5, *middle, n + 1, 2 * n + 1))


@pytest.mark.parametrize("middle", [(3,), (3, 4)])
def test_folding(middle: tuple[int, ...]) -> None:
    torch.manual_seed(0)
    for level in (0, 1, 3):
        crown = random_crown(level, *middle)
        compare(lambda crown=crown: from_crown(crown))  # type: ignore[misc]


@pytest.mark.parametrize("kind", ["batch", "instance"])
def test_norms(kind: str) -> None:
    torch.manual_seed(0)
    for dims, middle in ((2, (3,)), (3, (3, 4))):
        norm = crown_norm(kind, dims, 3).eval()
        with torch.no_grad():
            for tensor in norm.state_dict().values():
                if tensor.is_floating_point():
                    tensor.uniform_(0.5, 1.5)
        crown = random_crown(2, *middle)
        for part in range(2):
            compare(lambda: norm(crown)[part].detach())  # noqa: B023


def test_norm_in_training_has_statistics_of_the_batch() -> None:
    crown = random_crown(1, 3, 4)
    compare(lambda: CrownBatchNorm3d(3)(crown).col.detach())


@pytest.mark.parametrize("norm", ["batch", "instance"])
def test_blocks(norm: str) -> None:
    torch.manual_seed(0)
    block, volume = CrownBlock3d(3, 4, 3, norm, residual=True).eval(), torch.randn(2, 3, 5, 162)
    with torch.inference_mode():
        compare(lambda: block(volume))


def test_derivatives_are_looked_up_too() -> None:
    """Of crowns and of means over places, of any order, without adding up into places."""
    values = torch.rand(2, 1, 2, 12, dtype=torch.float64, requires_grad=True)

    def squared(values: Tensor) -> Tensor:
        crown = to_crown(values)
        return from_crown(Crown(crown.col.square(), crown.row.pow(3)))

    with kernels("graph"):
        assert torch.autograd.gradcheck(squared, values)
        assert torch.autograd.gradgradcheck(squared, values)
        loss = squared(values).sum()
        with Names() as names:
            loss.backward()
    assert not {"index_add", "scatter_add"} & names.seen


class Names(TorchDispatchMode):
    """Which operators are asked for."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: set[str] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.seen.add(func.overloadpacket.__name__.rstrip("_"))
        return func(*args, **(kwargs or {}))
