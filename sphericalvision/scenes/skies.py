# SPDX-License-Identifier: Apache-2.0
"""The same scene under another sky, or without lamps: what other people's pictures and meshes look like.

A network that has seen one blue sky only takes a white, black or cloudy one for a ceiling.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from sphericalvision.scenes.rendering.scene import Scene, pack_lamps

__all__ = ["under_another_sky", "unlit"]

BLACK, WHITE, FLAT, GRADIENT = 0.1, 0.15, 0.1, 0.25
"""Shares of skies that are black (a mesh without one), white (too bright), of one colour, and of two colours; the
others have clouds."""
WAVES = 32


def under_another_sky(scene: Scene, generator: torch.Generator) -> Scene:
    """Return the scene with another sky: black, white, of any one or two colours, or with clouds.

    Nothing else changes: the light that falls on surfaces is that of before.

    Args:
        scene: already exposed.
        generator: source of every random choice.

    Examples:
        >>> from sphericalvision.scenes import make_scene
        >>> scene = under_another_sky(make_scene("outdoors", seed=1), torch.Generator().manual_seed(3))
        >>> scene.background.shape, scene.clouds.shape[-1]
        (torch.Size([2, 3]), 5)
    """

    def uniform(least: float, most: float, *shape: int) -> Tensor:
        return least + (most - least) * torch.rand(shape, generator=generator)

    kind = uniform(0, 1).item()
    clouds = torch.zeros(0, 5)
    if kind < BLACK:
        shown = torch.zeros(2, 3)
    elif kind < BLACK + WHITE:
        shown = uniform(0.95, 1.1, 2, 1).expand(2, 3)
    else:
        # Mostly pale; a hue of any strength now and then.
        shown = uniform(0.15, 1.05, 2, 1) + uniform(0, 1).item() * uniform(-0.35, 0.35, 2, 3)
        if kind < BLACK + WHITE + FLAT:
            shown = shown[:1].expand(2, 3)
        elif kind >= BLACK + WHITE + FLAT + GRADIENT:
            clouds = _clouds(uniform)
    background = shown.clamp(min=0) ** 2.2 / scene.exposure
    return replace(scene, background=background, clouds=clouds)


def _clouds(uniform: Callable[..., Tensor]) -> Tensor:
    """Waves of many lengths, flatter towards the horizon, with more of the long ones."""
    count = 2 ** uniform(1.5, 5.0, WAVES)
    towards = torch.nn.functional.normalize(uniform(-1, 1, WAVES, 3), dim=-1) * torch.tensor([1.0, 2.5, 1.0])
    sharpness = uniform(1.0, 5.0).item()
    amplitude = count ** -uniform(0.5, 1.0).item()
    amplitude = sharpness * amplitude / (amplitude.square().sum() / 2).sqrt()
    waves = torch.cat([count[:, None] * towards, uniform(0, 2 * math.pi, WAVES, 1), amplitude[:, None]], -1)
    # A wave of no length is a constant: how much of the sky clouds cover.
    cover = torch.tensor([[0.0, 0.0, 0.0, math.pi / 2, sharpness * uniform(-1.2, 0.8).item()]])
    return torch.cat([waves, cover])


def unlit(scene: Scene) -> Scene:
    """Return the scene with nothing but even light, as meshes that are drawn without lamps; not yet exposed.

    Examples:
        >>> from sphericalvision.scenes import make_scene
        >>> len(unlit(make_scene("bare", seed=1)).lamps.position)
        0
    """
    even = scene.ambient.mean().expand(3).clone()
    return replace(scene, lamps=pack_lamps([]), ambient=even)
