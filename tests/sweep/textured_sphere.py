# SPDX-License-Identifier: Apache-2.0
"""What cameras see from inside a textured sphere around them: depth that is known, and can be found everywhere."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.icosphere import Icosphere


def textured_sphere(rig: CameraRig, depth: float, level: int = 5) -> Tensor:
    """Images ``(1, n, 3, V)`` from inside a textured sphere of radius ``depth`` around the rig."""
    generator = torch.Generator().manual_seed(3)
    waves = 8 * torch.randn(40, 3, generator=generator)
    phases = 2 * math.pi * torch.rand(3, 40, generator=generator)
    rays = Icosphere(level).vertices
    start = (rig.positions - rig.center)[:, None]
    along = (start * rays).sum(-1)
    reach = -along + (along.square() + depth**2 - start.square().sum(-1)).sqrt()
    points = torch.nn.functional.normalize(start + reach[..., None] * rays, dim=-1)
    colors = ((points @ waves.T)[..., None, :] + phases).sin().mean(-1) * 3
    return colors.clamp(-1, 1).movedim(-1, 1)[None]
