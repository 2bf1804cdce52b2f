# SPDX-License-Identifier: Apache-2.0
"""The rectangles of a crown a few at a time, for work that never has all of them in memory."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sphericalvision.crown.fast.layout import places_per_vertex
from sphericalvision.crown.places import place_ids

__all__ = ["PlaceSum", "RectangleGroup", "Rectangles"]

CACHE_BYTES = 16 << 20
"""Five rectangles that together take no more than this are taken together."""


class RectangleGroup(NamedTuple):
    """One or five rectangles of one kind, padded by their own border values.

    Attributes:
        first: number of the first one, 0 to 4.
        is_row: whether they are ``row`` rectangles, not ``col`` rectangles.
        places: ``(g, N' + 2, h + 2, w + 2)``, which of the values ``(N * V, C)`` stands where. With ``slack`` there are
            two more rows and columns, of no meaning.
    """

    first: int
    is_row: bool
    places: Tensor


class Rectangles:
    """All rectangles of volumes ``(N, V, C)``, in groups of one or five.

    Args:
        volumes: one sample ``(N, V, C)``: shape, dtype and device are what counts.
        level: of the icosphere.
        full: N' to which hypotheses are filled up, by repeating the last one.
        slack: whether to leave two more rows and columns after each rectangle.
        by_five: whether to take five together however large they are.

    Attributes:
        group_size: rectangles in a group.
        size: places of a group without borders, ``N' * h * w`` of each rectangle, the same for both kinds.
    """

    def __init__(
        self, volumes: Tensor, level: int, full: int, slack: bool = False, by_five: bool = False
    ) -> None:
        self.level, self.full, self.slack = level, full, slack
        self.n = n = 2**level
        self.count, self.vertices, channels = volumes.shape
        bytes_of_five = 5 * (2 * n + 1) * (n + 1) * full * channels * volumes.element_size()
        by_five = by_five or volumes.device.type != "cpu" or bytes_of_five <= CACHE_BYTES
        self.group_size = 5 if by_five else 1
        self.size = self.group_size * full * (2 * n + 1) * (n + 1)
        self.device = volumes.device

    def __len__(self) -> int:
        return 10 // self.group_size

    def __iter__(self) -> Iterator[RectangleGroup]:
        n = self.n
        hypotheses = torch.arange(-1, self.full + 1, device=self.device).clamp(0, self.count - 1)
        short, long = ([0, *range(m), m - 1] for m in (n + 1, 2 * n + 1))
        for is_row, ids in enumerate(place_ids(self.level, self.device).split(5)):
            ids = ids.view(5, n + 1, 2 * n + 1) if is_row else ids.view(5, 2 * n + 1, n + 1)
            down, right = (short, long) if is_row else (long, short)
            ids = ids[:, down][:, :, right]
            if self.slack:
                ids = F.pad(ids, (0, 2, 0, 2))
            for first in range(0, 5, self.group_size):
                group = ids[first : first + self.group_size]
                places = hypotheses[:, None, None] * self.vertices + group[:, None]
                yield RectangleGroup(first, bool(is_row), places)


class PlaceSum:
    """The sum of every vertex over all its places, group by group: first the col rectangles, then the row rectangles.

    The first row and the last column of a col rectangle belong to the next one; they are kept apart until the end.

    Args:
        values: ``(N, V, C)``, contiguous, where the sum is made.
        n: edges of a triangle of the icosahedron, ``2**level``.
    """

    def __init__(self, values: Tensor, n: int) -> None:
        count, _, channels = values.shape
        self.n, self.values = n, values
        self.charts = self.values[:, 1:-1].view(count, 5, 2 * n, n, channels)
        self.top = values.new_empty(count, 5, n + 1, channels)
        self.east = values.new_empty(count, 5, 2 * n, channels)

    def add(self, rectangles: Float[Tensor, "g N h w C"], group: RectangleGroup) -> None:
        """Add values ``(g, N, h, w, C)`` at the places of a group."""
        n = self.n
        for k, rectangle in enumerate(rectangles, group.first):
            if not group.is_row:
                self.charts[:, k] = rectangle[:, 1:, :-1]
                self.top[:, k], self.east[:, k] = rectangle[:, 0], rectangle[:, 1:, -1]
                continue
            self.top[:, k] += rectangle[:, 0, : n + 1]
            self.charts[:, k, :n] += rectangle[:, 1:, :n]
            self.east[:, k, :n] += rectangle[:, 1:, n]
            following = (k + 1) % 5
            self.charts[:, following, n - 1 :, 1:] += rectangle[:, :, n + 1 : -1]
            self.east[:, following, n - 1 :] += rectangle[:, :, -1]

    def total(self) -> Float[Tensor, "N V C"]:
        """Values ``(N, V, C)``, once everything is added."""
        n, charts, top, east = self.n, self.charts, self.top, self.east
        self.values[:, 0] = top[:, :, 0].sum(1)
        self.values[:, -1] = east[:, :, -1].sum(1)
        charts[:, :, :n, 0] += top[:, :, 1:].roll(1, 1)
        charts[:, :, n:, 0] += east[:, :, :n].roll(1, 1)
        charts[:, :, -1, 1:] += east[:, :, n:-1].roll(1, 1)
        return self.values

    def mean(self) -> Float[Tensor, "N V C"]:
        """Values ``(N, V, C)``: the sums by the number of places."""
        return self.total().mul_(places_per_vertex(self.n, self.values)[:, None].reciprocal_())
