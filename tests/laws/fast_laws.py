# SPDX-License-Identifier: Apache-2.0
"""What must hold for every fast way: it gives the numbers of the reference, in both passes and in every mode of torch.

A case is a function or a module and the shape of its input. Operators without parameters and whole networks are tested
alike; a new operator is one line in a list of cases.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch import Tensor, nn

from sphericalvision.kernels import kernels

__all__ = [
    "FastCase",
    "law_gradients_agree",
    "law_gradients_of_gradients_agree",
    "law_modes_agree",
    "law_values_agree",
]


@dataclass(frozen=True)
class FastCase:
    """A function with a fast way.

    Attributes:
        name: shown by pytest.
        make: a new module of the same parameters each time, or a function of one tensor.
        shape: of one sample of the input.
    """

    name: str
    make: Callable[[], Callable[[Tensor], Any]]
    shape: tuple[int, ...]

    def function(self, dtype: torch.dtype) -> Callable[[Tensor], Any]:
        """The function in a precision, with the same parameters and statistics each time."""
        torch.manual_seed(0)
        made = self.make()
        if not isinstance(made, nn.Module):
            return made
        made = made.to(dtype)
        with torch.no_grad():
            for name, values in [*made.named_parameters(), *made.named_buffers()]:
                if "norm" in name and values.is_floating_point():  # as after training, not as at its start
                    values.add_(torch.rand_like(values) / 2)
        return made

    def inputs(self, batch: int, dtype: torch.dtype) -> Tensor:
        """Random inputs."""
        generator = torch.Generator().manual_seed(batch)
        return torch.randn(batch, *self.shape, generator=generator, dtype=torch.float64).to(dtype)


def _tensors(result: Any) -> list[Tensor]:
    return [result] if isinstance(result, Tensor) else list(result)


def _assert_close(found: Sequence[Tensor], wanted: Sequence[Tensor], tolerance: float) -> None:
    """Differences are small beside the largest value."""
    for one, other in zip(found, wanted, strict=True):
        assert one.shape == other.shape
        assert one.dtype == other.dtype
        scale = max(float(other.detach().abs().max()), 1e-3) if other.numel() else 1.0
        torch.testing.assert_close(one, other, rtol=0, atol=tolerance * scale)


def law_values_agree(
    case: FastCase, batch: int, dtype: torch.dtype, training: bool, way: str = "auto"
) -> None:
    """Values, and running statistics after a step of training, with and without gradients."""
    tolerance = 1e-9 if dtype == torch.float64 else 2e-4
    expected, *others = _expected_values(case, batch, dtype, training)
    for answer in (*others, *_values(case, batch, dtype, training, way)):
        _assert_close(answer, expected, tolerance)


def _values(case: FastCase, batch: int, dtype: torch.dtype, training: bool, way: str) -> list[list[Tensor]]:
    """Values and statistics, with and without gradients."""
    inputs, answers = case.inputs(batch, dtype), []
    for grad in (True, False):
        function = case.function(dtype)
        if isinstance(function, nn.Module):
            function.train(training)
        with kernels(way), torch.set_grad_enabled(grad):
            result = _tensors(function(inputs))
        buffers = list(function.buffers()) if isinstance(function, nn.Module) else []
        answers.append([*(x.detach() for x in result), *buffers])
    return answers


@cache  # each way is compared with it
def _expected_values(case: FastCase, batch: int, dtype: torch.dtype, training: bool) -> list[list[Tensor]]:
    return _values(case, batch, dtype, training, "reference")


@cache
def _expected_gradients(case: FastCase, batch: int, training: bool, second: bool) -> list[Tensor]:
    return _gradients(case, batch, training, "reference", second)


def _gradients(case: FastCase, batch: int, training: bool, way: str, second: bool) -> list[Tensor]:
    """Gradients in float64 by inputs and parameters; the second ones are of a sum that weighs all first ones."""
    function = case.function(torch.float64)
    parameters = []
    if isinstance(function, nn.Module):
        parameters = list(function.train(training).parameters())
    inputs = case.inputs(batch, torch.float64).requires_grad_()
    generator = torch.Generator().manual_seed(7)

    def weigh(tensors: Sequence[Tensor | None]) -> Tensor:
        parts = [
            (x * torch.randn(x.shape, generator=generator, dtype=x.dtype)).sum()
            for x in tensors
            if x is not None
        ]
        return torch.stack(parts).sum()

    with kernels(way):
        total = weigh([x.square() for x in _tensors(function(inputs))])
        found = torch.autograd.grad(total, [inputs, *parameters], create_graph=second, materialize_grads=True)
        if second:
            total = weigh([x for x in found if x.requires_grad])
            found = torch.autograd.grad(total, [inputs, *parameters], materialize_grads=True)
    return list(found)


def law_gradients_agree(case: FastCase, batch: int, training: bool, way: str = "auto") -> None:
    """Gradients by inputs and parameters, in float64."""
    found = _gradients(case, batch, training, way, False)
    _assert_close(found, _expected_gradients(case, batch, training, False), 1e-7)


def law_gradients_of_gradients_agree(case: FastCase, batch: int, training: bool, way: str = "auto") -> None:
    """Gradients of gradients by inputs and parameters, in float64."""
    expected = _expected_gradients(case, batch, training, True)
    assert any(x.abs().max() > 0 for x in expected)
    _assert_close(_gradients(case, batch, training, way, True), expected, 1e-6)


def law_modes_agree(case: FastCase, batch: int, way: str = "auto") -> None:
    """What was computed in inference mode leaves nothing behind that training could not use, and the reverse."""
    function = case.function(torch.float32)
    if isinstance(function, nn.Module):
        function.eval()
    inputs = case.inputs(batch, torch.float32)
    with kernels(way):
        with torch.inference_mode():
            first = _tensors(function(inputs))
        result = _tensors(function(inputs.clone().requires_grad_()))
        if any(x.requires_grad for x in result):
            torch.stack([x.square().sum() for x in result]).sum().backward()
        with torch.inference_mode():
            again = _tensors(function(inputs))
    for one, other in zip(first, again, strict=True):
        assert torch.equal(one, other)
    _assert_close([x.detach() for x in result], [x.clone() for x in first], 2e-4)
