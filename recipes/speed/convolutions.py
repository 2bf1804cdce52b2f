# SPDX-License-Identifier: Apache-2.0
"""Convolutions on the sphere compared with the planar convolution of as many samples, forward and backward."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from omegaconf import DictConfig
from torch import Tensor, nn

from sphericalvision.core import kernels
from sphericalvision.crown import Crown, CrownConv2d, CrownConv3d, HexConv2d, HexConv3d, to_crown
from sphericalvision.icosphere import num_icosphere_vertices
from sphericalvision.recipes.speed.measuring import Comparison

__all__ = ["convolutions"]

HYPOTHESES = 16
"""Of the volumes, two levels coarser than the images."""


def convolutions(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """2D at every ``[level, channels]`` of ``convolution_settings``; 3D with 16 hypotheses two levels coarser."""
    for level, channels in config.convolution_settings:
        layers = {
            "planar": nn.Conv2d(channels, channels, 3, padding=1, bias=False),
            "hex along charts": HexConv2d(channels, channels),
            "crown, both directions": CrownConv2d(channels, channels),
        }
        yield _comparison(layers, level, (1, channels), config, device)
        if level >= 2:
            layers = {
                "planar": nn.Conv3d(channels, channels, 3, padding=1, bias=False),
                "hex along charts": HexConv3d(channels, channels),
                "crown, both directions": CrownConv3d(channels, channels),
            }
            # Two volumes: for a single small one torch takes a convolution on the CPU that is several times slower.
            yield _comparison(layers, level - 2, (2, channels, HYPOTHESES), config, device)


def _comparison(
    layers: dict[str, nn.Module], level: int, shape: tuple[int, ...], config: DictConfig, device: torch.device
) -> Comparison:
    """Layers on values of a shape at the vertices of a level, the first on an image of as many pixels."""
    vertices, rows = num_icosphere_vertices(level), 2 ** (level + 1)
    image = torch.randn(*shape, rows, 5 * rows // 2, device=device)  # the vertices but the poles
    values = torch.randn(*shape, vertices, device=device)
    runs: dict[str, Callable[[], object]] = {}
    for name, layer in layers.items():
        inputs = image if name == "planar" else to_crown(values) if name.startswith("crown") else values
        runs[name] = _forward_and_backward(layer, inputs)
        if name != "planar" and "layers" in config.options:
            runs[f"{name}, layers"] = kernels("plain")(runs[name])
    hypotheses = f", {HYPOTHESES} hypotheses" if len(shape) == 3 else ""
    title = f"{shape[0]} x {vertices} samples{hypotheses}, {shape[1]} channels"
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
