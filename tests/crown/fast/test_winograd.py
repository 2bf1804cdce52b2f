# SPDX-License-Identifier: Apache-2.0
"""The fast ways to convolve volumes give the numbers of the direct way."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from sphericalvision.crown import (
    CrownBatchNorm3d,
    CrownConv3d,
    crown_conv3d,
    crown_relu,
    from_crown,
    to_crown,
)
from sphericalvision.crown.fast.chain import convolve_chain
from sphericalvision.crown.fast.norms import folded, is_affine
from sphericalvision.crown.fast.winograd import conv3d_winograd
from tests.crown.same import assert_same_values_and_gradients


def direct(volumes: Tensor, kernel: Tensor, bias: Tensor | None = None) -> Tensor:
    return F.conv3d(F.pad(volumes, (1, 1, 1, 1, 1, 1), mode="replicate"), kernel, bias)


@pytest.fixture(params=[0, 10**9], ids=["rows", "whole"], autouse=True)
def min_places(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Kernels a row at a time, as for large planes, and whole ones, as for small planes."""
    monkeypatch.setattr("sphericalvision.crown.fast.winograd_rows.MIN_PLACES", request.param)


@pytest.mark.parametrize("count", [4, 5, 6, 7, 8, 1])
def test_values_and_gradients_are_those_of_the_direct_sum(generator: torch.Generator, count: int) -> None:
    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64).requires_grad_()

    inputs = draw(2, 3, count, 5, 4), draw(2, 3, 3, 3, 3), draw(2)
    expected, result = direct(*inputs), conv3d_winograd(*inputs)
    assert_same_values_and_gradients(result, expected, inputs, generator)


@pytest.mark.parametrize("taps", [range(9), (1, 2, 3, 4, 5, 6, 7), (0, 1, 4, 7, 8), (3, 4, 5), (0,)])
@pytest.mark.parametrize("size", [(5, 4), (4, 3), (1, 1), (2, 7)])
def test_kernels_with_taps_missing(
    generator: torch.Generator, taps: Sequence[int], size: tuple[int, int]
) -> None:
    volumes = torch.randn(2, 3, 6, *size, generator=generator, dtype=torch.float64).requires_grad_()
    kernel = torch.randn(2, 3, 3, 9, generator=generator, dtype=torch.float64)
    missing = [tap for tap in range(9) if tap not in taps]
    kernel[..., missing] = 0
    kernel = kernel.unflatten(-1, (3, 3)).requires_grad_()
    expected, result = direct(volumes, kernel), conv3d_winograd(volumes, kernel, None, taps)
    torch.testing.assert_close(result, expected)
    upstream = torch.randn(expected.shape, generator=generator, dtype=torch.float64)
    ours, of_kernel = torch.autograd.grad(result, (volumes, kernel), upstream)
    theirs, of_direct = torch.autograd.grad(expected, (volumes, kernel), upstream)
    torch.testing.assert_close(ours, theirs)
    torch.testing.assert_close(of_kernel.flatten(-2)[..., taps], of_direct.flatten(-2)[..., taps])


def test_taps_that_are_zero_now_have_a_gradient(generator: torch.Generator) -> None:
    values = torch.randn(1, 32, 4, 42, generator=generator)
    weight = torch.zeros(32, 32, 21, requires_grad=True)
    crown_conv3d(to_crown(values), weight).col.sum().backward()
    assert weight.grad is not None
    assert weight.grad.abs().amin((0, 1)).min() > 0


def test_single_precision_error_is_small(generator: torch.Generator) -> None:
    volumes = torch.randn(1, 64, 8, 9, 5, generator=generator)
    kernel = torch.randn(64, 64, 3, 3, 3, generator=generator)
    exact = direct(volumes.double(), kernel.double())
    assert (conv3d_winograd(volumes, kernel) - exact).abs().max() < 1e-5 * exact.abs().max()


@torch.no_grad()
@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize(
    ("count", "channels"), [(8, (3, 4, 2)), (5, (32, 33, 32)), (6, (32, 40, 1)), (1, (2, 3, 1))]
)
def test_a_chain_equals_its_layers(
    generator: torch.Generator, level: int, count: int, channels: tuple[int, int, int]
) -> None:
    start, middle, end = channels
    values = torch.randn(2, start, count, 2 + 10 * 4**level, generator=generator)
    first = torch.randn(middle, start, 21, generator=generator) / start
    second = torch.randn(end, middle, 21, generator=generator) / middle
    bias = torch.randn(middle, generator=generator)
    expected = from_crown(crown_conv3d(crown_relu(crown_conv3d(to_crown(values), first, bias)), second))
    result = convolve_chain(values, [(first, bias), (second, None)])
    torch.testing.assert_close(result, expected, atol=1e-4, rtol=1e-5)


@torch.no_grad()
def test_a_chain_of_one_rectangle_at_a_time_equals_one_of_five(
    generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = torch.randn(1, 32, 12, 162, generator=generator)
    layers = [(torch.randn(32, 32, 21, generator=generator), torch.randn(32, generator=generator))] * 2
    five = convolve_chain(values, layers)
    monkeypatch.setattr("sphericalvision.crown.fast.rectangles.CACHE_BYTES", 0)
    monkeypatch.setattr("sphericalvision.crown.fast.winograd.TRANSFORM_BYTES", 0)
    one = convolve_chain(values, layers)
    torch.testing.assert_close(one, five, atol=1e-5 * float(five.abs().max()), rtol=1e-5)


@torch.no_grad()
def test_a_folded_normalisation_equals_the_separate_one(generator: torch.Generator) -> None:
    crown = to_crown(torch.randn(1, 3, 4, 42, generator=generator))
    conv, norm = CrownConv3d(3, 5), CrownBatchNorm3d(5)
    for values in (norm.weight, norm.bias, norm.running_mean):
        values.copy_(torch.randn(5, generator=generator))
    norm.running_var.copy_(torch.rand(5, generator=generator) + 0.1)
    assert not is_affine(norm)
    assert is_affine(norm.eval())
    expected, result = norm(conv(crown)), crown_conv3d(crown, *folded(conv.weight, norm))
    torch.testing.assert_close(result.col, expected.col, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(result.row, expected.row, atol=1e-5, rtol=1e-5)
