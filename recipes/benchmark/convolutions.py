# SPDX-License-Identifier: Apache-2.0
"""Convolutions on the sphere beside the planar convolution of as many samples, forward and backward."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.util import find_spec

import torch
from omegaconf import DictConfig
from torch import Tensor, nn

from sphericalvision.crown import (
    Crown,
    CrownConv2d,
    CrownConv3d,
    HexConv2d,
    HexConv3d,
    to_crown,
)
from sphericalvision.icosphere import num_icosphere_vertices
from sphericalvision.recipes.benchmark.measuring import Comparison
from sphericalvision.recipes.benchmark.ways import by
from sphericalvision.sphere import CubePad2d, EquirectangularPad2d, SphereConv2d

__all__ = ["comparisons"]


def comparisons(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """2D at every level and number of channels asked for; 3D with 16 hypotheses two levels coarser."""
    for level, channels in config.convolution_settings:
        layers = "layers" in config.options
        yield _planar(level, channels, device, layers)
        if level >= 2:
            yield _spatial(level - 2, channels, 16, device, layers)


def _planar(level: int, channels: int, device: torch.device, layers: bool) -> Comparison:
    n, vertices = 2**level, num_icosphere_vertices(level)
    image = torch.randn(1, channels, 2 * n, 5 * n, device=device)  # the vertices but the poles
    values = torch.randn(1, channels, vertices, device=device)
    side = round((vertices / 6) ** 0.5)
    faces = torch.randn(6, channels, side, side, device=device)

    def run(layer: nn.Module, given: Tensor | Crown) -> Callable[[], object]:
        return _forward_and_backward(layer.to(device), given)

    def planar(padding: int) -> nn.Module:
        return nn.Conv2d(channels, channels, 3, padding=padding, bias=False)

    runs = {
        "planar": run(planar(1), image),
        "planar, channels last": run(planar(1), image.contiguous(memory_format=torch.channels_last)),
        "hex along charts": run(HexConv2d(channels, channels), values),
        "hex along charts, channels last": run(HexConv2d(channels, channels), _channels_last(values)),
        "hex aligned with north": run(
            HexConv2d(channels, channels, orientation="north", level=level), values
        ),
        "crown, both directions": run(CrownConv2d(channels, channels), to_crown(values)),
        "crown, the plain way": by("reference", run(CrownConv2d(channels, channels), to_crown(values))),
        "tangent planes": run(SphereConv2d(channels, channels, bias=False), image),
        "planar, panorama padded": run(nn.Sequential(EquirectangularPad2d(1), planar(0)), image),
        "planar, cube padded": run(nn.Sequential(CubePad2d(1), planar(0)), faces),
    }
    if layers:
        runs |= {
            f"{name}, layers": by("plain", runs[name])
            for name in ("hex along charts", "crown, both directions")
        }
    if find_spec("hexagdly"):
        import hexagdly

        runs["hexagdly, planar"] = run(hexagdly.Conv2d(channels, channels, 1, 1, bias=False), image)
    return Comparison(
        f"convolution, forward and backward: {vertices} samples, {channels} to {channels} channels",
        runs,
        "planar",
        3 * 2 * 9 * channels**2 * 10 * n * n / 1e9,
        "GFLOP/s count nine taps for all; hexagons need seven, tangent planes sample before they multiply.",
    )


def _spatial(level: int, channels: int, hypotheses: int, device: torch.device, layers: bool) -> Comparison:
    n, vertices = 2**level, num_icosphere_vertices(level)
    # Two volumes: for a single small one torch takes a convolution on the CPU that is several times slower.
    volume = torch.randn(2, channels, hypotheses, 2 * n, 5 * n, device=device)
    values = torch.randn(2, channels, hypotheses, vertices, device=device)

    def run(layer: nn.Module, given: Tensor | Crown) -> Callable[[], object]:
        return _forward_and_backward(layer.to(device), given)

    runs = {
        "planar": run(nn.Conv3d(channels, channels, 3, padding=1, bias=False), volume),
        "hex along charts": run(HexConv3d(channels, channels), values),
        "hex aligned with north": run(
            HexConv3d(channels, channels, orientation="north", level=level), values
        ),
        "crown, both directions": run(CrownConv3d(channels, channels), to_crown(values)),
    }
    if layers:
        runs |= {
            f"{name}, layers": by("plain", runs[name])
            for name in ("hex along charts", "crown, both directions")
        }
    return Comparison(
        f"convolution, forward and backward: 2 x {vertices} samples, {hypotheses} hypotheses, "
        f"{channels} to {channels} channels",
        runs,
        "planar",
        3 * 2 * 27 * channels**2 * 2 * 10 * n * n * hypotheses / 1e9,
    )


def _forward_and_backward(layer: nn.Module, given: Tensor | Crown) -> Callable[[], object]:
    """Apply a layer and derive by its input and its parameters."""
    inputs = [
        tensor.detach().requires_grad_() for tensor in (given if isinstance(given, Crown) else (given,))
    ]
    argument = Crown(*inputs) if isinstance(given, Crown) else inputs[0]
    wanted = [*inputs, *layer.parameters()]

    def outputs() -> list[Tensor]:
        result = layer(argument)
        return list(result) if isinstance(result, Crown) else [result]

    weights = [torch.randn_like(output) for output in outputs()]
    return lambda: torch.autograd.grad(outputs(), wanted, weights)


def _channels_last(values: Tensor) -> Tensor:
    return values.movedim(1, -1).contiguous().movedim(-1, 1)
