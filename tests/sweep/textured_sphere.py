# SPDX-License-Identifier: Apache-2.0
"""What cameras see from inside a textured sphere around them: depth that is known, and can be found everywhere."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.icosphere import Icosphere
from sphericalvision.sweep import depth_from_index

NUM_HYPOTHESES, MIN_DEPTH = 9, 0.5


def sphere_at(index: float, rig: CameraRig, level: int = 5) -> Tensor:
    """Images ``(1, n, 3, V)`` from inside a textured sphere around the rig whose radius is that of a hypothesis."""
    depth = min(depth_from_index(torch.tensor(float(index)), NUM_HYPOTHESES, MIN_DEPTH).item(), 1e4)
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
