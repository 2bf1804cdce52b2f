# SPDX-License-Identifier: Apache-2.0
"""Where a world takes its randomness from."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Draws(NamedTuple):
    """The generators of one seed, by what is drawn from them: one more draw for one changes nothing of another."""

    kind: torch.Generator
    sky: torch.Generator
    rig: torch.Generator
    carrier: torch.Generator
    clutter: torch.Generator
    faults: torch.Generator
    brightness: torch.Generator
    images: torch.Generator
    """Of what happens to images, camera by camera, and after that of what happens to poses."""

    @classmethod
    def of(cls, seed: int) -> Draws:
        """The generators of a seed."""
        kind, rig, faults, carrier, clutter, brightness, sky = (
            torch.Generator().manual_seed(seed * 8 + purpose)  # eight a seed, so that no two seeds share one
            for purpose in range(7)
        )
        # The seed itself: the frames of the benchmark, and its published numbers, have what follows from it.
        images = torch.Generator().manual_seed(seed)
        return cls(kind, sky, rig, carrier, clutter, faults, brightness, images)


def choose(shares: Tensor, generator: torch.Generator) -> int:
    """The number of one of the shares ``(n,)``, each as often as its part of their sum."""
    drawn = torch.rand((), generator=generator)
    return int((shares.cumsum(0) / shares.sum() <= drawn).sum().clamp(max=len(shares) - 1))
