# SPDX-License-Identifier: Apache-2.0
"""Numbers and places of HEALPix pixels: rings, base faces, and the two orders.

The sphere is cut into twelve base faces of equal area, four around each pole and four between. On a face, (x, y) in
[0, 1]² keep areas; x grows towards north-east, y towards north-west. A pixel is a square of side ``1 / nside`` there.

References:
    K. M. Górski et al. (2005), "HEALPix: a framework for high-resolution discretization and fast analysis of data
    distributed on the sphere", equations 2 to 9 for the rings, section 5.3 for the projection.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, Int, Integer
from torch import Tensor

from sphericalvision.core import ArgumentError, check_tensor
from sphericalvision.geometry.directions import holds

NEIGHBOR_STEPS = ((-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1))
"""Steps in (x, y) from a pixel to those around it: in the south-west, west, north-west, ..., and south."""


# The twelve base faces, unrolled. In each, x points to the north-east and y to the north-west; east is to the right.
#
#        N0    N1    N2    N3           zone 0, faces 0 to 3: all four meet at the north pole
#       /  \  /  \  /  \  /  \
#     B0    B1    B2    B3    (B0)      zone 1, faces 4 to 7, around the equator
#       \  /  \  /  \  /  \  /
#        S0    S1    S2    S3           zone 2, faces 8 to 11: all four meet at the south pole
#
# For a face of each zone, what follows after a step out of it, (-1, -1), (0, -1), (1, -1), (-1, 0), ... in (x, y): the
# zone there (-1 where no face is), how many faces further east, and by how many quarters its frame is turned. From N0,
# (-1, -1) is south into S0, (0, -1) south-east into B1, and no face is due east, where N0, N1 and B1 meet. In the caps
# the frame is turned by one across the meridians in which two faces meet (N0, N1), and by two across the pole (N0, N2).
_NONE = (-1, 0, 0)
_CROSSINGS = (
    ((2, 0, 0), (1, 1, 0), _NONE, (1, 0, 0), (0, 0, 0), (0, 1, 1), _NONE, (0, 3, 3), (0, 2, 2)),
    (_NONE, (2, 0, 0), (1, 1, 0), (2, 3, 0), (1, 0, 0), (0, 0, 0), (1, 3, 0), (0, 3, 0), _NONE),
    ((2, 2, 2), (2, 1, 3), _NONE, (2, 3, 1), (2, 0, 0), (1, 1, 0), _NONE, (1, 0, 0), (0, 0, 0)),
)


def nested_from_ring(ids: Integer[Tensor, "*batch"], nside: int) -> Int[Tensor, "*batch"]:
    """Numbers ``(*)`` in the nested order of pixels numbered ring by ring ``(*)``; -1, no pixel, stays -1.

    Args:
        ids: of any integer type.
        nside: pixels along the side of a base face, a power of two.

    Returns:
        int64 ``(*)``.

    Raises:
        ArgumentError: if nside is no power of two, ids are no integers, or there is no such pixel.

    Examples:
        >>> nested_from_ring(torch.arange(6), 2).tolist()
        [3, 7, 11, 15, 2, 1]
    """
    pixels = _checked(ids, nside)
    return torch.where(ids < 0, -1, nested_from_place(*place_from_ring(pixels, nside), nside))


def ring_from_nested(ids: Integer[Tensor, "*batch"], nside: int) -> Int[Tensor, "*batch"]:
    """Numbers ``(*)`` ring by ring of pixels numbered in the nested order ``(*)``: the inverse of ``nested_from_ring``,
    with the same arguments and errors.

    Examples:
        >>> ring_from_nested(torch.arange(4), 2).tolist()  # the four children of base face 0
        [13, 5, 4, 0]
    """
    pixels = _checked(ids, nside)
    return torch.where(ids < 0, -1, ring_from_place(*place_from_nested(pixels, nside), nside))


def _checked(ids: Tensor, nside: int) -> Tensor:
    """Numbers ``(*)`` of pixels in int64, which holds them all, the first one in place of -1, or ``ArgumentError``."""
    check_tensor("ids", ids, "(*)")
    if ids.is_floating_point() or ids.is_complex() or ids.dtype == torch.bool:
        raise ArgumentError(
            f"ids: expected integers, got {ids.dtype}; use .long() if these are whole numbers"
        )
    ids = ids.long()
    if not holds((ids >= -1) & (ids < 12 * nside**2)):
        raise ArgumentError(
            f"ids: expected pixels 0 to {12 * nside**2 - 1}, or -1 for none, got {int(ids.min())} to {int(ids.max())}"
        )
    return ids.clamp(min=0)


def nested_from_place(
    face: Int[Tensor, "*batch"], column: Int[Tensor, "*batch"], row: Int[Tensor, "*batch"], nside: int
) -> Int[Tensor, "*batch"]:
    """Nested numbers ``(*)``: the face, then the bits of row (y) and column (x) in turns."""
    ids = face * nside**2
    for bit in range(_order(nside)):
        ids = ids + (((column >> bit) & 1) << (2 * bit)) + (((row >> bit) & 1) << (2 * bit + 1))
    return ids


def place_from_nested(
    ids: Int[Tensor, "*batch"], nside: int
) -> tuple[Int[Tensor, "*batch"], Int[Tensor, "*batch"], Int[Tensor, "*batch"]]:
    """Face, column (x) and row (y), each ``(*)``, of nested numbers ``(*)``."""
    column, row = torch.zeros_like(ids), torch.zeros_like(ids)
    for bit in range(_order(nside)):
        column = column + (((ids >> (2 * bit)) & 1) << bit)
        row = row + (((ids >> (2 * bit + 1)) & 1) << bit)
    return torch.div(ids, nside**2, rounding_mode="floor"), column, row


def ring_from_place(
    face: Int[Tensor, "*batch"], column: Int[Tensor, "*batch"], row: Int[Tensor, "*batch"], nside: int
) -> Int[Tensor, "*batch"]:
    """Ring numbers ``(*)`` of pixels at ``column`` (x) and ``row`` (y) of a base face."""
    ring = (torch.div(face, 4, rounding_mode="floor") + 2) * nside - column - row - 1
    start, count, shift = ring_start_count_shift(ring, nside)
    # In pixels of its ring, the middle of a face is at count / 8 times an odd (polar) or even (belt) number.
    center = _middle(face) * torch.div(count, 4, rounding_mode="floor")
    position = torch.div(center + column - row + 1 - shift, 2, rounding_mode="floor")
    return start + position % count


def place_from_ring(
    ids: Int[Tensor, "*batch"], nside: int
) -> tuple[Int[Tensor, "*batch"], Int[Tensor, "*batch"], Int[Tensor, "*batch"]]:
    """Face, column and row of ring numbers: each pixel's centre lies in the middle of its square."""
    ring = ring_of_pixel(ids, nside)
    start, count, shift = ring_start_count_shift(ring, nside)
    quarters = (ids - start + 0.5 * shift.double()) * (4 / count.double())
    face, x, y = _place(ring.double() / nside, quarters)
    column, row = ((side * nside).floor().long().clamp(0, nside - 1) for side in (x, y))
    return face, column, row


def ring_of_pixel(ids: Int[Tensor, "*batch"], nside: int) -> Int[Tensor, "*batch"]:
    """Ring ``(*)``, 1 (north) to ``4 * nside - 1``, of ring numbers ``(*)``."""
    cap, total = 2 * nside * (nside - 1), 12 * nside**2

    def of_cap(number: Tensor) -> Tensor:  # ring i of a cap starts at 2 i (i - 1)
        ring = ((1 + (1 + 2 * number.double()).sqrt()) / 2).long()
        ring = ring - (2 * ring * (ring - 1) > number).long()  # the root may be rounded across an integer
        return ring + (2 * ring * (ring + 1) <= number).long()

    belt = nside + torch.div(ids - cap, 4 * nside, rounding_mode="floor")
    north, south = of_cap(ids.clamp(min=0)), 4 * nside - of_cap((total - 1 - ids).clamp(min=0))
    return torch.where(ids < cap, north, torch.where(ids >= total - cap, south, belt))


def ring_start_count_shift(
    ring: Int[Tensor, "*batch"], nside: int
) -> tuple[Int[Tensor, "*batch"], Int[Tensor, "*batch"], Int[Tensor, "*batch"]]:
    """First pixel, number of pixels and shift (0 or 1, in half pixels) of rings ``(*)`` from 1 to ``4 * nside - 1``."""
    from_pole = torch.minimum(ring, 4 * nside - ring)
    cap = from_pole < nside
    count = 4 * from_pole.clamp(max=nside)
    belt = 2 * nside * (nside - 1) + 4 * nside * (ring - nside)
    south = 12 * nside**2 - 2 * from_pole * (from_pole + 1)
    start = torch.where(cap, torch.where(ring < nside, 2 * ring * (ring - 1), south), belt)
    return start, count, torch.where(cap, 1, (ring - nside + 1) % 2)


def ring_theta(ring: Int[Tensor, "*batch"], nside: int, dtype: torch.dtype) -> Float[Tensor, "*batch"]:
    """Angle from the north pole ``(*)`` of rings ``(*)``; 0 and π for the rings 0 and ``4 * nside``."""
    z, radius = _height(ring.double() / nside)
    return torch.atan2(radius, z).to(dtype)


def neighbor_places(
    face: Int[Tensor, " P"], column: Int[Tensor, " P"], row: Int[Tensor, " P"], nside: int
) -> tuple[Int[Tensor, "P 8"], Int[Tensor, "P 8"], Int[Tensor, "P 8"], Bool[Tensor, "P 8"]]:
    """Face, column and row of the eight pixels around others in the order of ``NEIGHBOR_STEPS``, and which there are.

    Where three base faces meet, at the east and west corners of a cap's and the north and south corners of a belt's, a
    pixel has seven neighbours.
    """
    steps = torch.tensor(NEIGHBOR_STEPS, device=face.device)
    x, y = column[:, None] + steps[:, 0], row[:, None] + steps[:, 1]
    over_x, over_y = ((side >= nside).long() - (side < 0).long() for side in (x, y))
    x, y = x - over_x * nside, y - over_y * nside
    zone = torch.div(face, 4, rounding_mode="floor")[:, None]
    crossings = torch.tensor(_CROSSINGS, device=face.device)[zone, 3 * over_y + over_x + 4]
    next_zone, around, turn = crossings.unbind(-1)
    mirrored_x, mirrored_y = nside - 1 - x, nside - 1 - y
    columns = torch.stack((x, y, mirrored_x, mirrored_y), -1).gather(-1, turn[..., None]).squeeze(-1)
    rows = torch.stack((y, mirrored_x, mirrored_y, x), -1).gather(-1, turn[..., None]).squeeze(-1)
    return 4 * next_zone.clamp(min=0) + (face[:, None] + around) % 4, columns, rows, next_zone >= 0


def place_of_direction(
    unit: Float[Tensor, "*batch 3"],
) -> tuple[Int[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Base face and (x, y) in [0, 1], each ``(*)``, of unit directions ``(*, 3)``."""
    x, y, z = unit.unbind(-1)
    flat = 1 - (x * x + z * z) / (1 + y.abs())  # |y|, exact near the poles
    cap = (3 * (1 - flat)).clamp(min=0).sqrt()
    belt = 2 + 1.5 * y
    ring = torch.where(y.abs() <= 2 / 3, belt, torch.where(y < 0, cap, 4 - cap))
    quarters = torch.remainder(torch.atan2(x, z) * (2 / math.pi), 4)
    return _place(ring, quarters)


def direction_of_place(
    face: Int[Tensor, "*batch"], x: Float[Tensor, "*batch"], y: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 3"]:
    """Unit directions ``(*, 3)`` of places (x, y) in [0, 1] of base faces, each ``(*)``."""
    ring = torch.div(face, 4, rounding_mode="floor") + 2 - x - y
    from_pole = torch.minimum(ring, 4 - ring).clamp(0, 1)
    pole = from_pole == 0
    quarters = _middle(face) / 2 + (x - y) / (2 * torch.where(pole, 1.0, from_pole))
    # In a cap faces narrow towards the pole, but their middles stay.
    longitude = quarters * (math.pi / 2)
    up, radius = _height(ring)
    return torch.stack((radius * longitude.sin(), -up, radius * longitude.cos()), -1)


def _place(ring: Tensor, quarters: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Base face and (x, y) of points at ``ring`` in [0, 4] (1 to 3 the belt) and longitude in quarter turns [0, 4]."""
    falling, rising = quarters + 0.5 * (ring - 1), quarters + 1.5 - 0.5 * ring
    a, b = falling.floor(), rising.floor()
    belt_face = torch.where(a == b, a % 4 + 4, torch.where(a < b, a % 4, b % 4 + 8))
    quarter = quarters.floor().clamp(0, 3)
    along = quarters - quarter
    cap = torch.minimum(ring, 4 - ring)
    north, south = ring < 1, ring > 3
    face = torch.where(north, quarter, torch.where(south, quarter + 8, belt_face)).long()
    x = torch.where(north, 1 - (1 - along) * cap, torch.where(south, along * cap, rising - b))
    y = torch.where(north, 1 - along * cap, torch.where(south, (1 - along) * cap, 1 - (falling - a)))
    return face, x, y


def _height(ring: Tensor) -> tuple[Tensor, Tensor]:
    """Height towards the north pole and distance from the axis, each ``(*)``, at rings ``(*)`` in [0, 4]."""
    from_pole = torch.minimum(ring, 4 - ring).clamp(min=0)
    depth = torch.where(from_pole < 1, from_pole.square() / 3, 1 - (4 / 3 - 2 / 3 * from_pole))
    height = torch.where(ring <= 2, 1 - depth, depth - 1)
    return height, (depth * (2 - depth)).clamp(min=0).sqrt()


def _middle(face: Tensor) -> Tensor:
    """Longitude of a face's middle in eighths of a turn: odd at the poles, even in the belt."""
    belt = (face >= 4) & (face < 8)
    return 2 * (face % 4) + torch.where(belt, 0, 1)


def _order(nside: int) -> int:
    if nside < 1 or nside & (nside - 1):
        raise ArgumentError(f"nside: the nested order needs a power of two (1, 2, 4, 8, ...), got {nside}")
    return nside.bit_length() - 1
