# SPDX-License-Identifier: Apache-2.0
"""Where a world takes its randomness from.

A seed has to mean the same for ever: caches, splits and published numbers name samples by it. So there are three
orders of draws, for three families of sets: random rigs (``by_purpose``), scenes around one rig (``by_seed``), and
scenes around the rig of a capture that a network is adapted to (``by_seed_and_globally``). One order for all would
give every seed of two of them another scene.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Draws", "by_purpose", "by_seed", "by_seed_and_globally"]


class Draws(NamedTuple):
    """The generators of one seed, by what is drawn from them; None is torch's global one.

    Where two purposes share a generator, they draw in the order of the fields.
    """

    kind: torch.Generator
    sky: torch.Generator
    rig: torch.Generator
    carrier: torch.Generator
    faults: torch.Generator | None
    brightness: torch.Generator
    images: torch.Generator | None
    poses: torch.Generator | None
    choose: Callable[[Tensor, torch.Generator], int]
    """From shares ``(n,)`` to the number of one of them."""


def by_purpose(seed: int) -> Draws:
    """A generator for each purpose, so that one more draw for one changes nothing of another.

    Only what happens to images goes on where the carrier stopped.
    """
    kind, rig, faults, carrier, poses, brightness, sky = (
        torch.Generator().manual_seed(seed * 8 + purpose)  # eight a seed, so that no two seeds share one
        for purpose in range(7)
    )
    return Draws(kind, sky, rig, carrier, faults, brightness, carrier, poses, _by_cumulated_shares)


def by_seed(seed: int) -> Draws:
    """Each purpose starts from the seed itself; faults of poses are drawn after those of images."""
    kind, sky, rig, carrier, faults, brightness, images = (
        torch.Generator().manual_seed(seed) for _ in range(7)
    )
    return Draws(kind, sky, rig, carrier, faults, brightness, images, images, _by_cumulated_shares)


def by_seed_and_globally(seed: int) -> Draws:
    """The scene and what is in view follow from the seed; faults are others each time, from torch's generator."""
    world = torch.Generator().manual_seed(seed)
    return Draws(world, world, world, world, None, world, None, None, _by_multinomial)


def _by_cumulated_shares(shares: Tensor, generator: torch.Generator) -> int:
    drawn = torch.rand((), generator=generator)
    return int((shares.cumsum(0) / shares.sum() <= drawn).sum().clamp(max=len(shares) - 1))


def _by_multinomial(shares: Tensor, generator: torch.Generator) -> int:
    return int(torch.multinomial(shares, 1, generator=generator))
