# SPDX-License-Identifier: Apache-2.0
"""Where rays enter and leave the four unit shapes, in closed form.

Origins ``(3, m, 1)`` or ``(3, m, n)`` and directions ``(3, m, n)`` are in the shapes' own frames, directions of any
length. Comparisons cost more than arithmetic here, so a ray that misses is told by ``enter > leave`` alone.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = [
    "HUGE",
    "INTERSECTIONS",
    "intersect_box",
    "intersect_cylinder",
    "intersect_rectangle",
    "intersect_round",
]

#: Added to components of directions, so that none is zero.
TINY = 1e-20
#: Turns the least miss into a distance that no hit has.
HUGE = 1e30

Span = tuple[Tensor, Tensor]


def intersect_rectangle(o: Tensor, d: Tensor) -> Span:
    """The time at which z = 0, twice, where |x| and |y| stay below 1."""
    back = o[2] / (d[2] + TINY)
    x, y = torch.addcmul(o[:2], d[:2], back, value=-1).abs_()
    beyond = torch.maximum(x, y).sub_(1).clamp_(min=0)
    time = back.neg_()
    return torch.add(time, beyond, alpha=HUGE), time


def intersect_box(o: Tensor, d: Tensor) -> Span:
    """When all coordinates stay in [-1, 1]."""
    inverse = (d + TINY).reciprocal_()
    middle = o * inverse
    reach = inverse.abs_()
    enter = torch.add(middle, reach).amin(0).neg_()
    return enter, reach.sub_(middle).amin(0)


def intersect_round(o: Tensor, d: Tensor) -> Span:
    """When the coordinates' norm stays below 1; accurate from afar, too."""
    # The discriminant is taken at the point of the ray that is nearest to the centre, where everything is small; the
    # textbook's b² - 4ac subtracts two large numbers there and loses what is left of a ball seen from afar.
    inverse = d.square().sum(0).clamp_(min=1e-18).reciprocal_()
    middle = (o * d).sum(0).mul_(inverse)  # of the other sign
    room = 1 - torch.addcmul(o, d, middle, value=-1).square_().sum(0)
    miss = room.clamp(max=0)
    reach = room.clamp_(min=0).mul_(inverse).sqrt_()
    enter = (middle + reach).neg_()
    return enter.sub_(miss, alpha=HUGE), reach.sub_(middle)


def intersect_cylinder(o: Tensor, d: Tensor) -> Span:
    """When x² + z² <= 1 and |y| <= 1."""
    side_enter, side_leave = intersect_round(o[::2], d[::2])
    cap_enter, cap_leave = intersect_box(o[1:2], d[1:2])
    return torch.maximum(side_enter, cap_enter), torch.minimum(side_leave, cap_leave)


#: By shape, in the order of SHAPES.
INTERSECTIONS = (intersect_rectangle, intersect_box, intersect_round, intersect_cylinder)
