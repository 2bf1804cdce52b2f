# SPDX-License-Identifier: Apache-2.0
"""A block computed rectangle by rectangle is the same block on whole crowns, in both passes."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from sphericalvision.crown import (
    CrownBatchNorm3d,
    crown_conv3d,
    crown_relu,
    from_crown,
    to_crown,
)
from sphericalvision.crown.fast.block import Moments, NormedLayer, convolve_block
from sphericalvision.crown.fast.norms import track
from tests.crown.fast.test_native import compiler_is_there
from tests.crown.same import assert_same_values_and_gradients


def inputs(generator: torch.Generator, batch: int, count: int, level: int) -> list[Tensor]:
    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64).requires_grad_()

    values = draw(batch, 2, count, 2 + 10 * 4**level)
    return [values, draw(3, 2, 21), draw(3), draw(3), draw(4, 3, 21), draw(4), draw(4)]


def norm_of(scale: Tensor, shift: Tensor) -> CrownBatchNorm3d:
    norm = CrownBatchNorm3d(len(scale)).double()
    del norm.weight, norm.bias
    norm.weight, norm.bias = scale, shift
    return norm


def on_whole_crowns(values: Tensor, *parameters: Tensor) -> tuple[Tensor, list[CrownBatchNorm3d]]:
    weight1, scale1, shift1, weight2, scale2, shift2 = parameters
    norms = [norm_of(scale1, shift1), norm_of(scale2, shift2)]
    crown = crown_relu(norms[0](crown_conv3d(to_crown(values), weight1)))
    return from_crown(norms[1](crown_conv3d(crown, weight2))), norms


def block(values: Tensor, *parameters: Tensor, native: bool = False) -> tuple[Tensor, list[Moments]]:
    weight1, scale1, shift1, weight2, scale2, shift2 = parameters
    first, second = NormedLayer(weight1, scale1, shift1, 1e-5), NormedLayer(weight2, scale2, shift2, 1e-5)
    return convolve_block(values, first, second, native)


@pytest.mark.parametrize(("batch", "count", "level"), [(2, 4, 1), (1, 6, 1), (1, 8, 0), (1, 5, 2)])
@pytest.mark.parametrize("cache_bytes", [0, 1 << 30])
def test_values_and_gradients_are_those_of_whole_crowns(
    generator: torch.Generator,
    monkeypatch: pytest.MonkeyPatch,
    batch: int,
    count: int,
    level: int,
    cache_bytes: int,
) -> None:
    monkeypatch.setattr("sphericalvision.crown.fast.rectangles.CACHE_BYTES", cache_bytes)
    monkeypatch.setattr("sphericalvision.crown.fast.winograd.TRANSFORM_BYTES", cache_bytes)
    monkeypatch.setattr("sphericalvision.crown.fast.winograd_rows.MIN_PLACES", cache_bytes)
    tensors = inputs(generator, batch, count, level)
    (expected, _), (result, _) = on_whole_crowns(*tensors), block(*tensors)
    assert_same_values_and_gradients(result, expected, tensors, generator)


@pytest.mark.skipif(not compiler_is_there(), reason="needs a C++ compiler and ninja")
@pytest.mark.parametrize("cache_bytes", [0, 1 << 30])
def test_operators_give_values_and_gradients_of_whole_crowns(
    generator: torch.Generator, monkeypatch: pytest.MonkeyPatch, cache_bytes: int
) -> None:
    monkeypatch.setattr("sphericalvision.crown.fast.rectangles.CACHE_BYTES", cache_bytes)
    tensors = inputs(generator, 2, 5, 1)
    (expected, _), (result, _) = on_whole_crowns(*tensors), block(*tensors, native=True)
    assert_same_values_and_gradients(result, expected, tensors, generator)


def test_the_second_layer_may_be_without_normalisation(generator: torch.Generator) -> None:
    values, weight1, scale1, shift1, weight2, *_ = inputs(generator, 2, 6, 1)
    tensors = values, weight1, scale1, shift1, weight2
    norm = norm_of(scale1, shift1)
    crown = crown_relu(norm(crown_conv3d(to_crown(values), weight1)))
    expected = from_crown(crown_conv3d(crown, weight2))
    result, moments = convolve_block(values, NormedLayer(weight1, scale1, shift1, 1e-5), NormedLayer(weight2))
    assert len(moments) == 1
    assert_same_values_and_gradients(result, expected, tensors, generator)


def test_statistics_are_those_of_the_normalisation(generator: torch.Generator) -> None:
    tensors = inputs(generator, 2, 5, 1)
    _, norms = on_whole_crowns(*tensors)
    _, moments = block(*tensors)
    for norm, moment in zip(norms, moments, strict=True):
        tracked = CrownBatchNorm3d(len(norm.running_mean)).double()
        track(tracked, moment)
        torch.testing.assert_close(tracked.running_mean, norm.running_mean)
        torch.testing.assert_close(tracked.running_var, norm.running_var)
        assert tracked.num_batches_tracked == norm.num_batches_tracked == 1


def test_volumes_without_a_gradient_need_none(generator: torch.Generator) -> None:
    values, *parameters = inputs(generator, 1, 4, 1)
    weight = parameters[0]
    (expected,) = torch.autograd.grad(block(values, *parameters)[0].square().sum(), weight)
    (found,) = torch.autograd.grad(block(values.detach(), *parameters)[0].square().sum(), weight)
    assert expected.abs().max() > 0
    torch.testing.assert_close(found, expected)
