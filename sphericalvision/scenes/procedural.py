# SPDX-License-Identifier: Apache-2.0
"""Procedural scenes for training and tests: a seed makes a scene, any rig takes its pictures.

Convention:
    * A scene lives in the world frame of the rig (x right, y down, z forward, metres), centred on the rig.
    * The same seed makes the same scene on every device.
    * Nothing stands nearer than ``clear_radius`` (0.6 m) to the rig's centre.

Examples:
    >>> import torch
    >>> from sphericalvision.scenes.rendering.render import ray_depth, render_directions
    >>> scene = make_scene("room", seed=3)
    >>> directions = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    >>> render_directions(scene, torch.zeros(3), directions).shape
    torch.Size([3, 2])
    >>> bool((ray_depth(scene, torch.zeros(3), directions) > 0.6).all())
    True
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.core import ArgumentError, check_type
from sphericalvision.kernels import full_precision
from sphericalvision.scenes.registry import scene_recipe, under_other_skies
from sphericalvision.scenes.rendering.render import render_directions
from sphericalvision.scenes.rendering.scene import Scene, pack_lamps

BLACK, WHITE, FLAT, GRADIENT = 0.1, 0.15, 0.1, 0.25
"""Shares of skies that are black (a mesh without one), white (too bright), of one colour, and of two colours; the
others have clouds."""
WAVES = 32


@full_precision
def make_scene(
    kind: str = "room",
    seed: int = 0,
    device: torch.device | str | None = None,
    *,
    center: Float[Tensor, " 3"] | None = None,
    scale: float = 1.0,
    clear_radius: float = 0.6,
) -> Scene:
    """The scene of a seed, well exposed for a rig at its centre.

    Args:
        kind: one of ``scenes.registry.scene_kinds()``: ``"room"`` (furnished, lit by lamps), ``"floating"`` (objects
            in mid-air in front of a distant shell), ``"outdoors"`` (ground below an infinitely distant sky), ...; each
            is described where it is made, in ``sphericalvision.scenes.kinds``.
        seed: the same seed makes the same scene.
        device: where the scene lives; the CPU by default.
        center: ``(3,)`` where the rig's centre is, metres; the origin by default.
        scale: multiplies every length but ``center``; 3 suits a rig and a least depth three times as large.
        clear_radius: free space around the rig before scaling, metres, below 1.

    Raises:
        ArgumentError: unknown kind, scale not positive, or a clear radius outside (0, 1).

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.scenes import render_rig
        >>> images = render_rig(make_scene("hall", seed=3), ring_rig(2, image_size=(16, 16)))
        >>> images["cam1"].shape
        torch.Size([3, 16, 16])
    """
    recipe = scene_recipe(kind)
    if not scale > 0:
        raise ArgumentError(f"scale: expected a positive factor, got {scale}")
    if not 0 < clear_radius < 1:
        raise ArgumentError(
            f"clear_radius: expected metres in (0, 1), got {clear_radius}; use scale for larger rigs"
        )
    check_type("seed", seed, int)
    generator = torch.Generator().manual_seed(seed)
    scene = recipe(generator, clear_radius)
    yaw = 2 * math.pi * torch.rand((), generator=generator).item()
    sin, cos = math.sin(yaw), math.cos(yaw)
    scene = scene.transformed(torch.tensor([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]))
    brightness = 0.38 + 0.17 * torch.rand((), generator=generator).item()
    position = None if center is None else center.cpu().float()
    scene = exposed(scene, brightness).scaled(scale).transformed(translation=position)
    if under_other_skies(kind):
        scene = under_another_sky(scene, generator)
    return scene if device is None else scene.to(device)


def exposed(scene: Scene, brightness: float, center: Float[Tensor, " 3"] | None = None) -> Scene:
    """The scene at the exposure at which the view from a place has the given mean brightness on a display.

    Args:
        scene: of which only the exposure changes.
        brightness: 0 to 1.
        center: ``(3,)`` metres; the origin when not given.
    """
    probes = 1000  # directions that are looked at
    k = torch.arange(probes) + 0.5
    height, angle = 1 - 2 * k / probes, k * math.pi * (3 - 5**0.5)
    across = (1 - height.square()).sqrt()
    directions = torch.stack([across * angle.cos(), height, across * angle.sin()], -1)
    dim = 0.1
    start = torch.zeros(3) if center is None else center.cpu().float()
    seen = render_directions(replace(scene, exposure=torch.tensor(dim)), start, directions)
    return replace(scene, exposure=dim * (brightness / seen.mean().clamp(min=1e-3)) ** 2.2)


def under_another_sky(scene: Scene, generator: torch.Generator) -> Scene:
    """Return the scene with another sky: black, white, of any one or two colours, or with clouds.

    A network that has seen one blue sky only takes a white, black or cloudy one for a ceiling. Nothing else
    changes: the light that falls on surfaces is that of before.

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
        levels = torch.zeros(2, 3)
    elif kind < BLACK + WHITE:
        levels = uniform(0.95, 1.1, 2, 1).expand(2, 3)
    else:
        # Mostly pale; a hue of any strength now and then.
        levels = uniform(0.15, 1.05, 2, 1) + uniform(0, 1).item() * uniform(-0.35, 0.35, 2, 3)
        if kind < BLACK + WHITE + FLAT:
            levels = levels[:1].expand(2, 3)
        elif kind >= BLACK + WHITE + FLAT + GRADIENT:
            clouds = _clouds(uniform)
    background = levels.clamp(min=0) ** 2.2 / scene.exposure
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
