# SPDX-License-Identifier: Apache-2.0
"""Operators in C++: convolutions by Winograd's algorithms along all dimensions, and what uses them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils import cpp_extension

from sphericalvision.cameras import ring_rig
from sphericalvision.core import MissingCompilerError
from sphericalvision.crown.fast.block import NormedLayer, convolve_block
from sphericalvision.crown.fast.chain import convolve_chain
from sphericalvision.crown.fast.hex_native import convolve_rectangles, hex_convolution, hex_factors
from sphericalvision.crown.fast.native import native_operators
from sphericalvision.crown.taps import COL_TAPS, ROW_TAPS, Taps, planar_kernel, repeat_border
from sphericalvision.models import IcoSweepNet


def compiler_is_there() -> bool:
    return shutil.which("c++") is not None and cpp_extension.is_ninja_available()


needs_compiler = pytest.mark.skipif(not compiler_is_there(), reason="needs a C++ compiler and ninja")


def direct(images: Tensor, weight: Tensor, bias: Tensor | None, taps: Taps) -> Tensor:
    """The sum over all taps, of images or of volumes."""
    if images.ndim == 4:
        return F.conv2d(repeat_border(images), planar_kernel(weight, taps), bias)
    return F.conv3d(repeat_border(images), planar_kernel(weight.unflatten(-1, (3, 7)), taps), bias)


@needs_compiler
@pytest.mark.parametrize("taps", [COL_TAPS, ROW_TAPS])
@pytest.mark.parametrize("size", [(4, 5, 9), (5, 8, 4), (1, 1, 2), (6, 17, 9), (5, 3), (17, 34)])
@pytest.mark.parametrize(("channels", "out"), [(3, 5), (16, 20), (17, 48)])
def test_values_and_gradients_are_those_of_the_direct_sum(
    generator: torch.Generator, taps: Taps, size: tuple[int, ...], channels: int, out: int
) -> None:
    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64).requires_grad_()

    inputs = draw(2, channels, *size), draw(out, channels, 7 if len(size) == 2 else 21), draw(out)
    result, expected = hex_convolution(*inputs, taps), direct(*inputs, taps)
    torch.testing.assert_close(result, expected)
    upstream = torch.randn(expected.shape, generator=generator, dtype=torch.float64)
    ours, theirs = (torch.autograd.grad(of, inputs, upstream) for of in (result, expected))
    torch.testing.assert_close(ours, theirs)


@needs_compiler
def test_error_of_single_precision_is_small(generator: torch.Generator) -> None:
    volumes = torch.randn(1, 64, 8, 17, 9, generator=generator).requires_grad_()
    weight = (torch.randn(64, 64, 21, generator=generator) / 36).requires_grad_()
    exact = direct(volumes.double(), weight.double(), None, COL_TAPS)
    result = hex_convolution(volumes, weight, None, COL_TAPS)
    assert (result - exact).abs().max() < 1e-5 * exact.abs().max()
    upstream = torch.randn(result.shape, generator=generator)
    for ours, theirs in zip(
        torch.autograd.grad(result, (volumes, weight), upstream),
        torch.autograd.grad(exact, (volumes, weight), upstream.double()),
        strict=True,
    ):
        assert (ours - theirs).abs().max() < 1e-5 * theirs.abs().max()


@needs_compiler
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
        result = hex_convolution(*inputs, None, ROW_TAPS)
        ours = torch.autograd.grad(result, inputs, upstream)
    finally:
        torch.set_num_threads(before)
    expected = direct(*inputs, None, ROW_TAPS)
    torch.testing.assert_close(result, expected, atol=1e-5, rtol=1e-5)
    theirs = torch.autograd.grad(expected, inputs, upstream)
    torch.testing.assert_close(ours, theirs, atol=1e-3, rtol=1e-4)


@needs_compiler
def test_parts_of_larger_tensors_are_convolved_and_written(generator: torch.Generator) -> None:
    around = torch.randn(2, 9, 8, 11, 20, generator=generator)
    weight, bias = torch.randn(16, 20, 21, generator=generator) / 20, torch.randn(16, generator=generator)
    given, result = around[:, 1:7, 1:, 2:-1], torch.zeros(2, 8, 7, 10, 16)
    convolve_rectangles(
        given, hex_factors(weight, COL_TAPS), bias, result[:, 1:7, :, 1:-1], COL_TAPS, rectify=True
    )
    expected = direct(given.movedim(-1, 1), weight, bias, COL_TAPS).relu().movedim(1, -1)
    torch.testing.assert_close(result[:, 1:7, :, 1:-1], expected, atol=1e-5, rtol=1e-5)
    assert not result[:, [0, 7]].any()  # nothing else is written
    assert not result[:, :, :, [0, -1]].any()


@needs_compiler
def test_operators_refuse_what_does_not_fit() -> None:
    factors = hex_factors(torch.zeros(5, 18, 21), COL_TAPS)
    given, result = torch.zeros(1, 6, 6, 6, 18), torch.zeros(1, 6, 6, 6, 5)
    convolve_rectangles(given, factors, None, result, COL_TAPS)
    for wrong in (
        (given.double(), factors, None, result),
        (given.movedim(-1, 1).contiguous().movedim(1, -1), factors, None, result),
        (given[..., :7], factors, None, result),
        (given, factors[..., :5].contiguous(), None, result),
        (given, factors[:1].contiguous(), None, result),
        (given, factors, torch.zeros(6), result),
        (given, factors, None, result[:, :5]),
        (given[0], factors, None, result),
    ):
        with pytest.raises(RuntimeError):
            convolve_rectangles(*wrong, COL_TAPS)


class Spy:
    """Counts calls of one of the operators."""

    def __init__(self, operators: Any) -> None:
        self.operators, self.calls = operators, 0

    def hex_convolve(self, *args: Any) -> None:
        self.calls += 1
        self.operators.hex_convolve(*args)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.operators, name)


@pytest.fixture
def spy(monkeypatch: pytest.MonkeyPatch) -> Iterator[Spy]:
    counter = Spy(native_operators())
    monkeypatch.setattr("sphericalvision.crown.fast.hex_native.native_operators", lambda: counter)
    return counter


@needs_compiler
@torch.no_grad()
@pytest.mark.parametrize(("level", "cache_bytes"), [(3, None), (3, 0), (1, None)])
def test_a_chain_equals_that_without(
    generator: torch.Generator,
    monkeypatch: pytest.MonkeyPatch,
    spy: Spy,
    level: int,
    cache_bytes: int | None,
) -> None:
    if cache_bytes is not None:
        monkeypatch.setattr("sphericalvision.crown.fast.rectangles.CACHE_BYTES", cache_bytes)
    values = torch.randn(2, 32, 6, 2 + 10 * 4**level, generator=generator)
    layers = [
        (torch.randn(40, 32, 21, generator=generator), torch.randn(40, generator=generator)),
        (torch.randn(32, 40, 21, generator=generator), None),
        (torch.randn(1, 32, 21, generator=generator), None),
    ]
    expected = convolve_chain(values, layers)
    assert not spy.calls
    result = convolve_chain(values, layers, native=True)
    assert spy.calls
    torch.testing.assert_close(result, expected, atol=1e-5 * float(expected.abs().max()), rtol=1e-5)


@needs_compiler
def test_a_block_that_normalises_by_its_own_statistics(generator: torch.Generator, spy: Spy) -> None:
    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    first = NormedLayer((draw(40, 32, 21) / 26).requires_grad_(), draw(40), draw(40), 1e-5)
    for second in (
        NormedLayer(draw(32, 40, 21) / 29, draw(32), draw(32), 1e-5),
        NormedLayer(draw(1, 40, 21)),
    ):
        values = draw(2, 32, 6, 642)
        expected, statistics = convolve_block(values, first, second)
        assert not spy.calls
        result, others = convolve_block(values, first, second, native=True)
        assert spy.calls
        torch.testing.assert_close(result, expected, atol=1e-4, rtol=1e-4)
        for ours, theirs in zip(others, statistics, strict=True):
            torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=1e-4)
        upstream = draw(*result.shape)
        (ours,) = torch.autograd.grad(result, first.weight, upstream)
        (theirs,) = torch.autograd.grad(expected, first.weight, upstream)
        assert (ours - theirs).norm() < 1e-2 * theirs.norm()  # a ReLU near zero may switch
        spy.calls = 0


@needs_compiler
@pytest.mark.parametrize("norm", ["batch", "instance"])
def test_a_network_estimates_the_same(generator: torch.Generator, spy: Spy, norm: str) -> None:
    torch.manual_seed(0)
    net = IcoSweepNet(5, 8, feature_channels=16, num_cameras=2, norm=norm)
    images = 2 * torch.rand(1, 2, 3, 10242, generator=generator) - 1
    rig = ring_rig(2)
    for module in net.modules():
        if isinstance(module, torch.nn.modules.batchnorm._BatchNorm):
            module.momentum = 1.0
    with torch.no_grad():
        net.train()(images, rig)  # with statistics of its inputs the network tells hypotheses apart
    net.eval()
    with torch.inference_mode():
        expected = net(images, rig)
        assert expected.std() > 0.1
        net.configure(native=True)
        result = net(images, rig)
    assert spy.calls
    torch.testing.assert_close(result, expected, atol=1e-4, rtol=0)


def test_without_a_compiler_the_error_says_what_is_needed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def load(*args: Any, **kwargs: Any) -> None:
        raise RuntimeError("Error building extension\nninja\n/bin/sh: 1: c++: not found\nend")

    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path / "new"))
    monkeypatch.setattr(cpp_extension, "load", load)
    native_operators.cache_clear()
    try:
        with pytest.raises(MissingCompilerError, match=r"c\+\+: not found.*g\+\+.*ninja.*new"):
            native_operators()
        assert not list((tmp_path / "new").iterdir())
        (tmp_path / "file").touch()
        monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path / "file"))
        with pytest.raises(MissingCompilerError, match="folder to write to"):
            native_operators()
    finally:
        native_operators.cache_clear()
