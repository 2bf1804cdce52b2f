# SPDX-License-Identifier: Apache-2.0
"""Kernels in Triton return what operators of torch do: in Triton's interpreter, which needs no GPU."""

import pytest
import torch

from sphericalvision import kernels
from tests.processes import python

MEDIANS = """
import math, torch
from sphericalvision.capture.preparation.light_triton import nanmedian_kernel

values = torch.rand(4, 9001, generator=torch.Generator().manual_seed(0))
values[0, ::3], values[1], values[2, :4000] = math.nan, math.nan, 0.0
for rows in (values, 1e-3 * values[:, :7]):
    torch.testing.assert_close(nanmedian_kernel(rows), rows.nanmedian(1).values, rtol=0, atol=0, equal_nan=True)
"""
SYSTEMS = """
import torch
from sphericalvision.capture.preparation.light_triton import elimination_kernel

generator = torch.Generator().manual_seed(0)
for number in (3, 20):
    root = torch.randn(2, number, number, generator=generator, dtype=torch.float64)
    matrix, right = root @ root.mT + torch.eye(number), torch.randn(2, number, generator=generator).double()
    torch.testing.assert_close(elimination_kernel(matrix, right), torch.linalg.solve(matrix, right))
"""
PATHS = """
import torch
from sphericalvision.kernels import kernels
from sphericalvision.geometry.means_by_id import mean_by_id
from sphericalvision.sweep import semi_global_smoothing
from sphericalvision.sweep.smoothing import _jump_penalties, smoothing_paths
from sphericalvision.sweep.smoothing_triton import path_costs_kernel

generator = torch.Generator().manual_seed(0)
cost, guide = torch.rand(2, 5, 42, generator=generator), torch.rand(2, 3, 42, generator=generator)
paths = smoothing_paths(1, cost.device)
for colors in (guide, None):
    with kernels("graph"):
        expected = semi_global_smoothing(cost, 0.3, 3.6, colors, 0.4)
    jumps = _jump_penalties(colors, paths, 0.3, 3.6, 0.4)
    arrived = path_costs_kernel(cost, paths.ids, jumps, 0.3, paths.first)
    torch.testing.assert_close(mean_by_id(arrived.flatten(2), paths.arrivals).transpose(0, 1), expected)
"""
HEXAGONS = """
import torch
from sphericalvision.crown import north_fraction
from sphericalvision.crown.fast.lookups import hexagons2d, hexagons_in_triton

generator = torch.Generator().manual_seed(0)
for channels, outputs, stride, north in ((5, 20, 1, None), (33, 16, 2, north_fraction(1))):
    values = torch.randn(2, channels, 42, generator=generator)
    weight, bias = torch.randn(outputs, channels, 7, generator=generator), torch.randn(outputs, generator=generator)
    plain = hexagons2d(values, weight, bias, stride, north)
    kernel = hexagons_in_triton(values, weight, bias, stride, north)
    torch.testing.assert_close(kernel, plain, rtol=1e-4, atol=1e-4)
    added = True, torch.randn(plain.shape, generator=generator)
    plain = hexagons2d(values, weight, None, stride, north, *added)
    values = values.mT.contiguous().mT  # channels may be the fastest in memory
    kernel = hexagons_in_triton(values, weight, None, stride, north, *added)
    torch.testing.assert_close(kernel, plain, rtol=1e-4, atol=1e-4)
"""
BORDERS = """
import torch
import torch.nn.functional as F
from sphericalvision.crown.fast.border_triton import RepeatBorder

for size in ((2, 3, 5, 9), (2, 3, 4, 9, 5), (1, 2, 1, 2, 3)):
    images = torch.randn(size, requires_grad=True)
    plain, kernel = F.pad(images, (1, 1) * (len(size) - 2), mode="replicate"), RepeatBorder.apply(images)
    assert torch.equal(kernel, plain)
    gradient = torch.randn_like(plain)
    expected, result = (torch.autograd.grad(padded, images, gradient)[0] for padded in (plain, kernel))
    torch.testing.assert_close(result, expected)
"""
COMPILED = """
from itertools import product

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from sphericalvision.crown.fast.hexconv_triton import _kernel

# As an argument that is 1 is compiled, which strides of values and of what is added are in turn.
for one, other in product(("value_vertex", "value_channel"), ("residual_vertex", "residual_channel")):
    constants = {"CHANNELS": 16, "VERTICES": 32, "OUTPUTS": 16, "INPUTS": 16, "PRECISION": "tf32x3", one: 1, other: 1}
    constants |= dict.fromkeys(("RECTIFY", "BIAS", "RESIDUAL"), True)
    kinds = dict.fromkeys(_kernel.arg_names, "i32")
    kinds |= dict.fromkeys(("values", "weight", "bias", "residual", "result"), "*fp32")
    kinds |= dict.fromkeys(("taps", "around"), "*i64") | dict.fromkeys(constants, "constexpr")
    source = ASTSource(fn=_kernel, signature=kinds, constexprs=constants)
    assert triton.compile(source, target=GPUTarget("cuda", 90, 32)).asm["cubin"]
"""


@pytest.mark.slow
def test_a_kernel_is_compiled_without_a_gpu() -> None:
    """The interpreter takes what the compiler does not."""
    pytest.importorskip(
        "triton", reason="kernels need Triton, which torch for CUDA brings along: pip install triton"
    )
    python("-c", COMPILED)


@pytest.mark.slow
@pytest.mark.parametrize(
    "program",
    [MEDIANS, SYSTEMS, PATHS, HEXAGONS, BORDERS],
    ids=["medians", "systems", "paths", "hexagons", "borders"],
)
def test_a_kernel_returns_what_operators_of_torch_do(program: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip(
        "triton", reason="kernels need Triton, which torch for CUDA brings along: pip install triton"
    )
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    python("-c", program)


@pytest.mark.parametrize(
    ("package", "compiler", "capability", "runs"),
    [
        (object(), "/usr/bin/gcc", (9, 0), True),
        (None, "/usr/bin/gcc", (9, 0), False),
        (object(), None, (9, 0), False),
        (object(), "/usr/bin/gcc", (6, 1), False),
    ],
    ids=["all there", "no Triton", "no compiler", "an old GPU"],
)
def test_where_kernels_do_not_run_operators_of_torch_do(
    package: object,
    compiler: str | None,
    capability: tuple[int, int],
    runs: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(kernels, "find_spec", lambda _: package)
    monkeypatch.setattr(kernels.shutil, "which", lambda _: compiler)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda _: capability)
    assert kernels.runs_triton.__wrapped__(torch.device("cuda")) is runs
    assert kernels.runs_triton.__wrapped__(torch.device("cpu")) is False
