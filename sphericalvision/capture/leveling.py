# SPDX-License-Identifier: Apache-2.0
"""Level a rig that leans by the floor that its depth shows."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.trajectory import upright_turn
from sphericalvision.capture.result import Depth
from sphericalvision.core import ArgumentError

MAX_LEAN = math.cos(math.radians(45))
"""Cosine of the greatest angle between the world's up and the floor's; a wall is farther away."""
BELOW = math.cos(math.radians(75))
"""Cosine of the angle from the world's down within which a floor is looked for; leaning included."""
TOLERANCE = 0.08
"""Of the inverse depth, for a direction to be on a plane."""
MIN_FLOOR = 0.3
"""Fraction of what is seen below that has to be one plane."""
MAX_SPREAD_DEG = 5.0
"""Between frames, above which the rig does not lean in one way."""
NUM_PLANES = 300


def floor_up(depth: Depth) -> Float[Tensor, " 3"] | None:
    """The direction that points up from the floor below a rig; None where no floor is seen.

    The inverse depth of a plane at the distance h with the normal n is linear in directions, n · direction / h. So a
    plane follows from three directions; the one with most of what is seen below on it is the floor, by least squares.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.models import SemiGlobalSweep
        >>> net, rig = SemiGlobalSweep(4, 16, 0.5), ring_rig(3)
        >>> leaning = torch.nn.functional.normalize(torch.tensor([0.2, -1.0, 0.0]), dim=0)
        >>> inverse = (net.grid.directions @ -leaning / 1.5).clamp_min(0.1)  # a floor 1.5 m below, walls 10 m away
        >>> ones = torch.ones(len(inverse))
        >>> (floor_up(Depth(inverse * 0.5 * 15, ones, ones > 0, net, rig, {})) - leaning).norm() < 1e-3
        tensor(True)
    """
    directions = depth.directions.reshape(-1, 3).double().cpu()
    inverse, confidence = (x.flatten().double().cpu() for x in (depth.inverse_depth, depth.confidence))
    below = depth.seen.flatten().cpu() & (directions[:, 1] > BELOW)
    directions, inverse, weights = directions[below], inverse[below], confidence[below]
    if len(inverse) < 3:
        return None
    # Planes through three directions each, drawn by their confidence and always the same ones.
    generator = torch.Generator().manual_seed(0)
    drawn = torch.multinomial(weights.clamp_min(1e-6), 3 * NUM_PLANES, True, generator=generator)
    triples = drawn.view(-1, 3)
    triples = triples[torch.linalg.det(directions[triples]).abs() > 1e-3]  # of one line there is no plane
    planes = torch.linalg.solve(directions[triples], inverse[triples].unsqueeze(-1)).squeeze(-1)
    planes = planes[planes[:, 1] > MAX_LEAN * planes.norm(dim=-1)]
    if not len(planes):
        return None
    on_plane = (planes @ directions.mT - inverse).abs() < TOLERANCE * inverse
    plane = planes[(on_plane * weights).sum(-1).argmax()]
    for _ in range(3):  # what lies on the better plane makes it better still
        is_close = (directions @ plane - inverse).abs() < TOLERANCE * inverse
        scale = weights[is_close].sqrt()[:, None]
        answer = torch.linalg.lstsq(scale * directions[is_close], scale * inverse[is_close, None])
        plane = answer.solution[:, 0]
    if float(weights[is_close].sum()) < MIN_FLOOR * float(weights.sum()):
        return None
    return -torch.nn.functional.normalize(plane, dim=0).float()


def leveling_turn(depths: Iterable[Depth]) -> tuple[Float[Tensor, "4 4"], str]:
    """The rotation ``(4, 4)`` that levels a rig by the floor in the depth of some frames, and a sentence on it.

    Raises:
        ArgumentError: no frame shows a floor.
    """
    ups = [up for depth in depths if (up := floor_up(depth)) is not None]
    if not ups:
        raise ArgumentError(
            "up: no frame shows a floor below the rig, a plane within 45° of level; use -y, y, z or camera"
        )
    mean = torch.nn.functional.normalize(torch.stack(ups).mean(0), dim=0)
    lean, spread = (_degrees(torch.tensor([0.0, -1.0, 0.0]), mean), max(_degrees(up, mean) for up in ups))
    sentence = f"the rig leans by {lean:.1f}°, by the floor in {len(ups)} frame(s)"
    if spread > MAX_SPREAD_DEG:
        sentence += f"; these differ by {spread:.0f}° from their mean: it does not lean in one way"
    leaning = torch.eye(4)
    leaning[:3, 1] = -mean  # of a camera that is upright on this floor
    return upright_turn("camera", leaning[None]), sentence


def _degrees(first: Tensor, second: Tensor) -> float:
    return math.degrees(math.atan2(float(torch.linalg.cross(first, second).norm()), float(first @ second)))
