# SPDX-License-Identifier: Apache-2.0
"""Few large operators give the numbers of the others."""

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from sphericalvision.crown import Crown, from_crown, to_crown
from sphericalvision.icosphere import icosphere_vertices
from sphericalvision.kernels import Operator, kernels, prefer_fused
from sphericalvision.tables import constant_table, copied


def test_where_few_large_operators_are() -> None:
    cpu, other = torch.device("cpu"), torch.device("meta")
    assert [prefer_fused(device) for device in (cpu, other)] == [False, True]
    with kernels("graph"):
        assert prefer_fused(cpu)
    with kernels("reference"):
        assert not prefer_fused(other)
    with kernels("plain"):
        assert Operator(lambda x: 1, cpu=lambda x: 2)(x=torch.ones(1)) == 2


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


def test_derivatives_are_looked_up_too() -> None:
    """Of crowns and of means over places, without adding up into places, and they are those of the reference."""
    values = torch.rand(2, 1, 2, 12, dtype=torch.float64, requires_grad=True)

    def squared(values: Tensor) -> Tensor:
        crown = to_crown(values)
        return from_crown(Crown(crown.col.square(), crown.row.pow(3)))

    with kernels("graph"):
        loss = squared(values).sum()
        with Names() as names:
            loss.backward()
    assert not {"index_add", "scatter_add"} & names.seen
    with kernels("reference"):
        (expected,) = torch.autograd.grad(squared(values).sum(), values)
    torch.testing.assert_close(values.grad, expected)


class Names(TorchDispatchMode):
    """Which operators are asked for."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: set[str] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.seen.add(func.overloadpacket.__name__.rstrip("_"))
        return func(*args, **(kwargs or {}))
