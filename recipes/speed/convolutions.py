# SPDX-License-Identifier: Apache-2.0
"""Convolutions on the sphere compared with the planar convolution of as many samples, forward and backward."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial

import torch
from omegaconf import DictConfig
from torch import Tensor, nn

from sphericalvision.core import kernels
from sphericalvision.crown import Crown, CrownConv2d, CrownConv3d, HexConv2d, HexConv3d, to_crown
from sphericalvision.icosphere import num_icosphere_vertices
from sphericalvision.recipes.speed.measuring import Comparison
from sphericalvision.sphere import CubePad2d, EquirectangularPad2d, SphereConv2d

__all__ = ["convolutions"]


def convolutions(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """2D at every ``[level, channels]`` of ``convolution_settings``; 3D with 16 hypotheses two levels coarser."""
    for level, channels in config.convolution_settings:
        vertices, rows = num_icosphere_vertices(level), 2 ** (level + 1)
        image = torch.randn(1, channels, rows, 5 * rows // 2, device=device)  # the vertices but the poles
        faces = torch.randn(6, channels, *[round((vertices / 6) ** 0.5)] * 2, device=device)
        planar, hexagons = (
            partial(nn.Conv2d, channels, channels, 3, bias=False),
            partial(HexConv2d, channels, channels),
        )
        padded, cube = (nn.Sequential(pad, planar()) for pad in (EquirectangularPad2d(1), CubePad2d(1)))
        layers = {
            "planar": (planar(padding=1), image),
            "planar, panorama padded": (padded, image),
            "planar, cube padded": (cube, faces),
            "tangent planes": (SphereConv2d(channels, channels, bias=False), image),
        }
        sphere = {
            "hex along charts": hexagons(),
            "hex aligned with north": hexagons(orientation="north", level=level),
            "crown, both directions": CrownConv2d(channels, channels),
        }
        values = torch.randn(1, channels, vertices, device=device)
        yield _comparison(f"{vertices} samples, {channels} channels", layers, sphere, values, config)
        if level >= 2:
            yield _volumes(level - 2, channels, 16, config, device)


def _volumes(
    level: int, channels: int, hypotheses: int, config: DictConfig, device: torch.device
) -> Comparison:
    vertices, rows = num_icosphere_vertices(level), 2 ** (level + 1)
    # Two volumes: for a single small one torch takes a convolution on the CPU that is several times slower.
    volume = torch.randn(2, channels, hypotheses, rows, 5 * rows // 2, device=device)
    sphere = {
        "hex along charts": HexConv3d(channels, channels),
        "hex aligned with north": HexConv3d(channels, channels, orientation="north", level=level),
        "crown, both directions": CrownConv3d(channels, channels),
    }
    values = torch.randn(2, channels, hypotheses, vertices, device=device)
    planar = {"planar": (nn.Conv3d(channels, channels, 3, padding=1, bias=False), volume)}
    title = f"2 x {vertices} samples, {hypotheses} hypotheses, {channels} channels"
    return _comparison(title, planar, sphere, values, config)


def _comparison(
    title: str,
    planar: Mapping[str, tuple[nn.Module, Tensor]],
    sphere: Mapping[str, nn.Module],
    values: Tensor,
    config: DictConfig,
) -> Comparison:
    """Planar layers on images, and layers of the sphere on values at vertices."""
    runs = {name: _forward_and_backward(layer, image) for name, (layer, image) in planar.items()}
    for name, layer in sphere.items():
        inputs = to_crown(values) if name.startswith("crown") else values
        runs[name] = _forward_and_backward(layer, inputs)
        if "layers" in config.options:
            runs[f"{name}, layers"] = kernels("plain")(runs[name])
    return Comparison(f"convolution, forward and backward: {title}", runs)


def _forward_and_backward(layer: nn.Module, values: Tensor | Crown) -> Callable[[], object]:
    """Apply a layer and derive by its input and its parameters."""
    inputs = [
        tensor.detach().requires_grad_() for tensor in (values if isinstance(values, Crown) else (values,))
    ]
    argument = Crown(*inputs) if isinstance(values, Crown) else inputs[0]
    layer = layer.to(inputs[0].device)
    variables = [*inputs, *layer.parameters()]

    def outputs() -> list[Tensor]:
        result = layer(argument)
        return list(result) if isinstance(result, Crown) else [result]

    weights = [torch.randn_like(output) for output in outputs()]
    return lambda: torch.autograd.grad(outputs(), variables, weights)
