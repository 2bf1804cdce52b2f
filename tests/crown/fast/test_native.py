# SPDX-License-Identifier: Apache-2.0
"""Winograd's algorithm in three dimensions: in PyTorch, and its operators in C++."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
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
from sphericalvision.crown.fast.native import native_operators
from sphericalvision.crown.fast.winograd_cubes import (
    CubeKernel,
    convolve_cubes,
    cube_kernel,
    results_of_products,
    tiles_of_volumes,
)
from sphericalvision.crown.fast.workspace import Workspace
from sphericalvision.models import IcoSweepNet

HEXAGON = (1, 2, 3, 4, 5, 6, 7)


def compiler_is_there() -> bool:
    return shutil.which("c++") is not None and cpp_extension.is_ninja_available()


needs_compiler = pytest.mark.skipif(not compiler_is_there(), reason="needs a C++ compiler and ninja")


def hexagonal(generator: torch.Generator, out_channels: int, channels: int) -> Tensor:
    kernel = torch.randn(out_channels, channels, 3, 3, 3, generator=generator)
    kernel[..., 0, 0] = kernel[..., 2, 2] = 0
    return kernel / (21 * channels) ** 0.5


@pytest.mark.parametrize("taps", [range(9), HEXAGON, (0, 1, 4, 7, 8), (3, 4, 5), (0,)])
@pytest.mark.parametrize("size", [(5, 4), (1, 2), (8, 9)])
def test_results_are_those_of_the_direct_sum(
    generator: torch.Generator, taps: Sequence[int], size: tuple[int, int]
) -> None:
    height, width = size
    padded = torch.randn(2, 10, height + 2, width + 2, 3, generator=generator, dtype=torch.float64)
    kernel = torch.randn(4, 3, 3, 9, generator=generator, dtype=torch.float64)
    kernel[..., [tap for tap in range(9) if tap not in taps]] = 0
    kernel = kernel.unflatten(-1, (3, 3))
    bias = torch.randn(4, generator=generator, dtype=torch.float64)
    result = padded.new_empty(2, 8, height, width, 4)
    convolve_cubes(padded, cube_kernel(kernel, taps), bias, result, Workspace(), rectify=True)
    expected = F.conv3d(padded.movedim(-1, 1), kernel, bias).relu().movedim(1, -1)
    torch.testing.assert_close(result, expected)


def test_zero_taps_leave_out_products(generator: torch.Generator) -> None:
    kernel = hexagonal(generator, 2, 3)
    factors, slots = cube_kernel(kernel, HEXAGON)
    assert factors.shape == (6 * 34, 3, 2)
    assert (slots < 0).nonzero().flatten().tolist() == [0, 35]
    assert cube_kernel(kernel).factors.shape == (6 * 36, 3, 2)


def test_slabs_change_nothing(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    padded = torch.randn(1, 22, 7, 6, 3, generator=generator)
    kernel = cube_kernel(hexagonal(generator, 4, 3), HEXAGON)
    whole, sliced = (torch.empty(1, 20, 5, 4, 4) for _ in range(2))
    convolve_cubes(padded, kernel, None, whole, Workspace())
    monkeypatch.setattr("sphericalvision.crown.fast.winograd_cubes.TILE_BYTES", 0)
    convolve_cubes(padded, kernel, None, sliced, Workspace())
    torch.testing.assert_close(sliced, whole)


def test_error_of_single_precision_is_small(generator: torch.Generator) -> None:
    padded = torch.randn(1, 10, 14, 10, 64, generator=generator)
    kernel = hexagonal(generator, 64, 64)
    result = padded.new_empty(1, 8, 12, 8, 64)
    convolve_cubes(padded, cube_kernel(kernel, HEXAGON), None, result, Workspace())
    exact = F.conv3d(padded.double().movedim(-1, 1), kernel.double()).movedim(1, -1)
    assert (result - exact).abs().max() < 1e-5 * exact.abs().max()


@needs_compiler
@pytest.mark.parametrize("channels", [1, 5, 8, 11, 16, 20, 40])
@pytest.mark.parametrize("size", [(5, 9), (1, 2), (8, 4)])
@pytest.mark.parametrize("rectify", [False, True])
def test_operators_equal_their_twins(
    generator: torch.Generator, channels: int, size: tuple[int, int], rectify: bool
) -> None:
    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    height, width = size
    operators = native_operators()
    slots = cube_kernel(torch.zeros(1, 1, 3, 3, 3), HEXAGON).slots
    places = 2 * 2 * -(-height // 4) * -(-width // 4)
    given = draw(2, 14, height + 3, width + 4, channels)[:, 2:12, 1:, 1:-1]  # a part of something larger
    tiles, expected = torch.empty(204, places, channels), torch.empty(204, places, channels)
    operators.winograd_tiles(given, slots, tiles)
    tiles_of_volumes(given, slots, expected)
    torch.testing.assert_close(tiles, expected, atol=2e-5, rtol=1e-5)

    products, bias = draw(204, places, channels), draw(channels) if rectify else None
    around, expected = torch.zeros(2, 9, height + 2, width + 1, channels), draw(2, 8, *size, channels)
    operators.winograd_results(products, slots, bias, rectify, around[:, 1:, 1:-1, :-1])
    results_of_products(products, slots, bias, rectify, expected)
    torch.testing.assert_close(around[:, 1:, 1:-1, :-1], expected, atol=2e-4, rtol=1e-5)
    assert not around[:, 0].any()  # nothing else is written
    assert not around[:, :, [0, -1]].any()
    assert not around[:, :, :, -1].any()


@needs_compiler
@pytest.mark.parametrize("threads", [1, 3])
def test_any_number_of_threads(generator: torch.Generator, threads: int) -> None:
    padded = torch.randn(2, 10, 11, 8, 16, generator=generator)
    kernel = cube_kernel(hexagonal(generator, 24, 16), HEXAGON)
    result, expected = torch.empty(2, 8, 9, 6, 24), torch.empty(2, 8, 9, 6, 24)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        convolve_cubes(padded, kernel, None, result, Workspace(), native=True)
    finally:
        torch.set_num_threads(before)
    convolve_cubes(padded, kernel, None, expected, Workspace())
    torch.testing.assert_close(result, expected, atol=1e-5, rtol=1e-5)


@needs_compiler
def test_operators_refuse_what_does_not_fit() -> None:
    operators, slots = native_operators(), cube_kernel(torch.zeros(1, 1, 3, 3, 3), HEXAGON).slots
    padded, tiles = torch.zeros(1, 6, 6, 6, 8), torch.zeros(204, 1, 8)
    operators.winograd_tiles(padded, slots, tiles)
    for wrong in (
        (padded.double(), slots, tiles),
        (padded.movedim(-1, 1).contiguous().movedim(1, -1), slots, tiles),
        (padded, slots, tiles[:, :, :4].contiguous()),
        (padded, slots, torch.zeros(204, 2, 8)),
        (padded, slots[:9].contiguous(), tiles),
        (padded, slots + 1, tiles),
        (padded[0], slots, tiles),
    ):
        with pytest.raises((RuntimeError, IndexError)):
            operators.winograd_tiles(*wrong)
    with pytest.raises(RuntimeError, match="bias"):
        operators.winograd_results(tiles, slots, torch.zeros(7), False, torch.zeros(1, 4, 4, 4, 8))


class Spy:
    """Counts calls of one of the operators."""

    def __init__(self, operators: Any) -> None:
        self.operators, self.calls = operators, 0

    def winograd_results(self, *args: Any) -> None:
        self.operators.winograd_results(*args)

    def winograd_tiles(self, *args: Any) -> None:
        self.calls += 1
        self.operators.winograd_tiles(*args)


@pytest.fixture
def spy(monkeypatch: pytest.MonkeyPatch) -> Iterator[Spy]:
    counter = Spy(native_operators())
    monkeypatch.setattr("sphericalvision.crown.fast.winograd_cubes.native_operators", lambda: counter)
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
    assert bool(spy.calls) == (level == 3)  # shorter sides leave too much of the cubes unused
    torch.testing.assert_close(result, expected, atol=1e-5 * float(expected.abs().max()), rtol=1e-5)
    double = convolve_chain(values.double(), [(layers[0][0].double(), None)], native=True)
    assert double.dtype == torch.float64


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


def test_factors_are_as_exact_as_their_kernel(generator: torch.Generator) -> None:
    kernel = hexagonal(generator, 3, 2)
    single, double = cube_kernel(kernel, HEXAGON), cube_kernel(kernel.double(), HEXAGON)
    assert isinstance(single, CubeKernel)
    torch.testing.assert_close(single.factors, double.factors.float(), atol=0, rtol=1e-7)
