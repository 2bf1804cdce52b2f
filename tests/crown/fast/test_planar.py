# SPDX-License-Identifier: Apache-2.0
"""Planar convolutions that keep no borders have the gradients of those that do."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from sphericalvision.crown.fast.planar import conv2d_replicate
from tests.crown.same import assert_same_values_and_gradients


def draw(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64).requires_grad_()


@pytest.mark.parametrize("size", [(3, 2), (9, 5), (5, 9)])
def test_values_and_gradients_are_those_of_the_direct_sum(
    generator: torch.Generator, size: tuple[int, int]
) -> None:
    inputs = draw(generator, 2, 3, *size), draw(generator, 4, 3, 3, 3), draw(generator, 4)
    images, kernel, bias = inputs
    expected = F.conv2d(F.pad(images, (1, 1, 1, 1), mode="replicate"), kernel, bias)
    result = conv2d_replicate(images, kernel, bias)
    assert_same_values_and_gradients(result, expected, inputs, generator)


def test_images_that_need_no_gradient_get_none(generator: torch.Generator) -> None:
    images, kernel = draw(generator, 1, 2, 5, 3).detach(), draw(generator, 2, 2, 3, 3)
    conv2d_replicate(images, kernel).sum().backward()
    assert kernel.grad is not None
    assert images.grad is None
