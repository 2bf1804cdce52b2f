# SPDX-License-Identifier: Apache-2.0
"""Operators in C++: convolutions by Winograd's algorithms along all dimensions, and what uses them."""

import pytest
import torch
from torch import Tensor

from sphericalvision.crown import HexConv2d
from sphericalvision.crown.fast.convolution import hex_convolution
from sphericalvision.crown.places import place_ids
from sphericalvision.crown.taps import COL_TAPS, convolve, planar_kernels, repeat_border
from sphericalvision.kernels import kernels
from tests.crown.compiler import needs_compiler

pytestmark = needs_compiler


@pytest.fixture(autouse=True, scope="module")
def loaded() -> None:
    with kernels("require"):
        HexConv2d(1, 1)(torch.zeros(1, 1, 12))


def by_operator(
    images: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    across: bool,
    border: bool = False,
    relu: bool = False,
) -> Tensor:
    """Images ``(B, C, [N,] h, w)`` through the operator, which has channels last and takes images as volumes."""
    volumes = (images.unsqueeze(2) if images.ndim == 4 else images).movedim(1, -1)
    result = hex_convolution(volumes, weight, bias, across, border, relu, None).movedim(-1, 1)
    return result.squeeze(2) if images.ndim == 4 else result


def direct(images: Tensor, weight: Tensor, bias: Tensor | None, across: bool) -> Tensor:
    """The sum over all taps, of images or of volumes."""
    return convolve(repeat_border(images), planar_kernels(weight)[int(across)], bias)


@pytest.mark.parametrize("across", [False, True])
@pytest.mark.parametrize("size", [(4, 5, 9), (5, 8, 4), (1, 1, 2), (6, 17, 9), (5, 40, 9), (5, 3), (17, 34)])
@pytest.mark.parametrize(("channels", "out"), [(3, 5), (16, 20), (17, 48)])
def test_values_and_gradients_are_those_of_the_direct_sum(
    generator: torch.Generator, across: bool, size: tuple[int, ...], channels: int, out: int
) -> None:
    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64).requires_grad_()

    inputs = draw(2, channels, *size), draw(out, channels, 7 if len(size) == 2 else 21), draw(out)
    result, expected = by_operator(*inputs, across), direct(*inputs, across)
    torch.testing.assert_close(result, expected)
    upstream = torch.randn(expected.shape, generator=generator, dtype=torch.float64)
    ours, theirs = (torch.autograd.grad(of, inputs, upstream) for of in (result, expected))
    torch.testing.assert_close(ours, theirs)


def test_error_of_single_precision_is_small(generator: torch.Generator) -> None:
    volumes = torch.randn(1, 64, 8, 17, 9, generator=generator).requires_grad_()
    weight = (torch.randn(64, 64, 21, generator=generator) / 36).requires_grad_()
    exact = direct(volumes.double(), weight.double(), None, False)
    result = by_operator(volumes, weight, None, False)
    assert (result - exact).abs().max() < 1e-5 * exact.abs().max()
    upstream = torch.randn(result.shape, generator=generator)
    for ours, theirs in zip(
        torch.autograd.grad(result, (volumes, weight), upstream),
        torch.autograd.grad(exact, (volumes, weight), upstream.double()),
        strict=True,
    ):
        assert (ours - theirs).abs().max() < 1e-5 * theirs.abs().max()


@pytest.mark.parametrize("threads", [1, 3])
def test_any_number_of_threads(generator: torch.Generator, threads: int) -> None:
    inputs = (
        torch.randn(2, 16, 9, 16, 7, generator=generator).requires_grad_(),
        (torch.randn(24, 16, 21, generator=generator) / 18).requires_grad_(),
    )
    upstream = torch.randn(2, 24, 9, 16, 7, generator=generator)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        result = by_operator(*inputs, None, True)
        ours = torch.autograd.grad(result, inputs, upstream)
    finally:
        torch.set_num_threads(before)
    expected = direct(*inputs, None, True)
    torch.testing.assert_close(result, expected, atol=1e-5, rtol=1e-5)
    theirs = torch.autograd.grad(expected, inputs, upstream)
    torch.testing.assert_close(ours, theirs, atol=1e-3, rtol=1e-4)


def test_parts_of_larger_tensors_are_by_operator(generator: torch.Generator) -> None:
    """Views of any strides, with and without channels next to each other, also with a border that is given."""
    weight, bias = torch.randn(16, 20, 21, generator=generator) / 20, torch.randn(16, generator=generator)
    around = torch.randn(2, 9, 8, 11, 20, generator=generator)
    for given in (around[:, 1:7, 1:, 2:-1].movedim(-1, 1), around.movedim(-1, 1).contiguous()[:, :, ::2]):
        expected = direct(given, weight, bias, False).relu()
        result = by_operator(given, weight, bias, False, relu=True)
        torch.testing.assert_close(result, expected, atol=1e-5, rtol=1e-5)
        inside = direct(given, weight, bias, False)[..., 1:-1, 1:-1]
        result = by_operator(given, weight, bias, False, border=True)
        torch.testing.assert_close(result, inside, atol=1e-5, rtol=1e-5)


def test_operators_pass_the_checks_of_torch() -> None:
    """Schema, fake results, autograd: what ``torch.compile`` and ``meta`` tensors rely on."""

    def draw(*shape: int) -> Tensor:
        return torch.randn(shape, requires_grad=True)

    operators, across = torch.ops.sphericalvision, place_ids(1)[5:].int().view(5, 3, 5)
    crown = draw(2, 5, 1, 5, 3, 3), draw(2, 5, 1, 3, 5, 3), draw(3), draw(3)
    for operator, inputs in (
        (operators.hex_convolution, (draw(2, 1, 5, 3, 3), draw(4, 3, 7), draw(4), True, False, False, None)),
        (operators.hex_convolution, (draw(1, 6, 5, 3, 17), draw(3, 17, 21), None, False, False, False, None)),
        (operators.hex_convolution, (draw(2, 1, 42, 3), draw(4, 3, 7), draw(4), True, False, False, across)),
        (operators.crown_normalization, (*crown, None, None, 1e-5, True, True)),
        (operators.crown_normalization, (*crown, draw(4, 3, 7), draw(4), 1e-5, False, True)),
    ):
        torch.library.opcheck(
            operator.default,
            inputs,
            test_utils=("test_schema", "test_autograd_registration", "test_faketensor"),
        )


def test_operators_refuse_what_does_not_fit() -> None:
    operators = torch.ops.sphericalvision
    given, result = torch.zeros(1, 6, 6, 6, 18), torch.zeros(1, 6, 6, 6, 5)
    weight, taps = torch.zeros(5, 18, 21), list(sum(COL_TAPS, ()))
    operators.hex_convolve(given, weight, taps, None, False, 0, result)
    for wrong in (
        (given.double(), weight, taps, None, False, 0, result),
        (given.movedim(-1, 1).contiguous().movedim(1, -1), weight, taps, None, False, 0, result),
        (given[..., :7], weight, taps, None, False, 0, result),
        (given, weight[:3], taps, None, False, 0, result),
        (given, weight[..., :7], taps, None, False, 0, result),
        (given, weight.mT.contiguous().mT, taps, None, False, 0, result),
        (given, weight, [6, *taps[1:]], None, False, 0, result),
        (given, weight, [7, 8, *taps[2:]], None, False, 0, result),
        (given, weight, taps[:7], None, False, 0, result),
        (given, weight, taps, torch.zeros(6), False, 0, result),
        (given, weight, taps, None, False, 0, result[:, :5]),
        (given[0], weight, taps, None, False, 0, result),
    ):
        with pytest.raises(RuntimeError):
            operators.hex_convolve(*wrong)
