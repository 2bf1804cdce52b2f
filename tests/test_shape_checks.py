# SPDX-License-Identifier: Apache-2.0
"""Annotations with shapes are checked in the tests, and nowhere else."""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path
from types import ModuleType

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.core import ShapeError
from sphericalvision.icosphere import Icosphere, locate
from sphericalvision.shapes import check_shapes
from sphericalvision.sweep.winner import winner_takes_all
from tests.processes import python
from tests.shape_checks import AnnotationError, CheckingLoader

EXAMPLE = '''
"""Functions that accept too much."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

if TYPE_CHECKING:
    from nowhere import Rig

__all__ = ["Pair", "Sum", "add", "pair", "total"]


class Pair(NamedTuple):
    """Points and where they count."""

    points: Float[Tensor, "*batch 3"]
    valid: Bool[Tensor, "*batch"]


def add(
    a: Float[Tensor, "*batch n"], b: Float[Tensor, "*batch n"] | float, rig: Rig | None = None
) -> Float[Tensor, "*batch n"]:
    """Add what broadcasts.

    >>> add(torch.ones(2, 3), 1.0).sum().item()
    12.0
    """
    if a.ndim > 4:
        raise ValueError("a: too many dimensions")
    return a + b


def pair(points: Tensor, valid: Tensor) -> Pair:
    """Take anything for a pair."""
    return Pair(points, valid)


def total(tables: Mapping[str, Float[Tensor, " n"]], *others: Float[Tensor, " n"]) -> Tensor:
    """Add up tables."""
    return sum(tables.values(), sum(others))


class Sum(torch.nn.Module):
    """Adds twice."""

    def forward(self, a: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
        return a + a

    @property
    def scale(self) -> Float[Tensor, " 2"]:
        return torch.ones(3)

    @staticmethod
    def first(a: Float[Tensor, "n 2"]) -> Float[Tensor, " n"]:
        return a[:, 0]
'''


@pytest.fixture
def example(tmp_path: Path) -> ModuleType:
    """The module above, imported as those of the package are."""
    path = tmp_path / "example.py"
    path.write_text(textwrap.dedent(EXAMPLE))
    module = ModuleType("example")
    sys.modules["example"] = module
    CheckingLoader("example", str(path)).exec_module(module)
    yield module
    del sys.modules["example"]


def test_names_mean_one_size_in_a_call(example: ModuleType) -> None:
    assert example.add(torch.ones(4, 2, 3), torch.ones(4, 2, 3)).shape == (4, 2, 3)
    assert example.add(torch.ones(3), 2.0).shape == (3,)
    with pytest.raises(AnnotationError, match=r"example.add: b is float32 \(3,\)"):
        example.add(torch.ones(2, 3), torch.ones(3))
    with pytest.raises(AnnotationError, match="a is int64"):
        example.add(torch.ones(3, dtype=torch.long), 2.0)
    with pytest.raises(AnnotationError, match=r"return is float32 \(2, 3\)"):
        example.add(torch.ones(3), torch.ones(2, 3).numpy())


def test_the_functions_own_errors_come_first(example: ModuleType) -> None:
    with pytest.raises(ValueError, match="too many"):
        example.add(torch.ones(1, 1, 1, 1, 1), torch.ones(7, dtype=torch.bool))


def test_fields_of_results_and_members_of_mappings(example: ModuleType) -> None:
    example.pair(torch.ones(5, 3), torch.ones(5, dtype=torch.bool))
    with pytest.raises(AnnotationError, match="return is"):
        example.pair(torch.ones(5, 3), torch.ones(4, dtype=torch.bool))
    example.total({"a": torch.ones(2)}, torch.ones(2))
    with pytest.raises(AnnotationError, match="tables is"):
        example.total({"a": torch.ones(2), "b": torch.ones(2, 2)})
    with pytest.raises(AnnotationError, match="others is"):
        example.total({"a": torch.ones(2)}, torch.ones(1))


def test_methods_properties_and_static_methods(example: ModuleType) -> None:
    module = example.Sum()
    assert module(torch.ones(3, 2)).sum() == 12
    for broken in (
        lambda: module(torch.ones(2, 3)),
        lambda: module.scale,
        lambda: module.first(torch.ones(3, 4)),
    ):
        with pytest.raises(AnnotationError):
            broken()


def test_what_is_traced_is_left_alone(example: ModuleType) -> None:
    module, values = example.Sum(), torch.ones(4, 2)
    size = torch.export.Dim("size", min=2, max=100)
    program = torch.export.export(module, (values,), dynamic_shapes=({0: size},))
    assert program.module()(torch.ones(7, 2)).shape == (7, 2)
    compiled = torch.compile(example.add, backend="eager", fullgraph=True)
    assert torch.equal(compiled(values, values), values + values)


def test_wrapped_functions_look_like_themselves(example: ModuleType) -> None:
    assert (example.add.__name__, example.add.__module__) == ("add", "example")
    assert example.add.__globals__ is vars(example)  # where doctest looks whose function this is
    assert example.add.__code__ is not example.pair.__code__  # torch.compile keeps programs by code


def test_refusals_have_all_sizes_of_a_batch() -> None:
    @check_shapes
    def both(values: Float[Tensor, "*batch n"], others: Float[Tensor, "*batch 3"]) -> None: ...

    with pytest.raises(ShapeError, match=r"others: expected shape \(4, 5, 3\), .*, got \(4, 6, 3\)"):
        both(torch.ones(4, 5, 2), torch.ones(4, 6, 3))


def test_the_package_is_checked() -> None:
    """Of what nothing in the library itself refuses."""
    assert hasattr(locate, "__wrapped__")
    assert hasattr(Icosphere.sample, "__wrapped__")
    with pytest.raises(AnnotationError, match="winner_takes_all: cost is int64"):
        winner_takes_all(torch.ones(1, 2, 12, dtype=torch.long))


def test_nothing_is_checked_outside_the_tests() -> None:
    program = """
        import sys, torch
        import sphericalvision.icosphere as icosphere
        from sphericalvision.sweep.winner import winner_takes_all
        winner_takes_all(torch.ones(1, 2, 12, dtype=torch.long))
        assert not hasattr(icosphere.icosphere_normals, "__wrapped__")
        assert not hasattr(icosphere.Icosphere.nearest, "__wrapped__")
        assert not any(name.startswith("tests") or "beartype" in name for name in sys.modules)
    """
    python("-c", textwrap.dedent(program))
