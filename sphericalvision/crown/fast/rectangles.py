# SPDX-License-Identifier: Apache-2.0
"""The rectangles of a crown a few at a time, for work that never has all of them in memory."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from sphericalvision.crown.layout import _place_ids, places_per_vertex

__all__ = ["PlaceSum", "Rectangles", "Some"]

CACHE_BYTES = 16 << 20
"""Five rectangles that together take no more than this are taken together."""


class Some(NamedTuple):
    """One or five rectangles of one direction, padded by their own border values.

    Attributes:
        first: number of the first one, 0 to 4.
        across: whether they are ``row`` rectangles, which lie across, not ``col`` rectangles.
        places: ``(g, N' + 2, h + 2, w + 2)`` rows of values ``(N * V, C)``. With ``room`` there are two more rows and
            columns, of no meaning.
    """

    first: int
    across: bool
    places: Tensor


class Rectangles:
    """All rectangles of volumes ``(N, V, C)``, in groups of one or five.

    Args:
        rows: one sample ``(N, V, C)``: shape, dtype and device are what counts.
        level: of the icosphere.
        full: N' to which hypotheses are filled up, by repeating the last one.
        room: whether to leave two more rows and columns after each rectangle.
        five: whether to take five together however large they are.

    Attributes:
        together: rectangles in a group.
        size: places of a group without borders, ``N' * h * w`` of each rectangle, the same for both directions.
    """

    def __init__(self, rows: Tensor, level: int, full: int, room: bool = False, five: bool = False) -> None:
        self.level, self.full, self.room = level, full, room
        self.n = n = 2**level
        self.count, self.vertices, channels = rows.shape
        bytes_of_five = 5 * (2 * n + 1) * (n + 1) * full * channels * rows.element_size()
        five = five or rows.device.type != "cpu" or bytes_of_five <= CACHE_BYTES
        self.together = 5 if five else 1
        self.size = self.together * full * (2 * n + 1) * (n + 1)
        self.device = rows.device

    def __len__(self) -> int:
        return 10 // self.together

    def __iter__(self) -> Iterator[Some]:
        n = self.n
        hypotheses = torch.arange(-1, self.full + 1, device=self.device).clamp(0, self.count - 1)
        wide, high = ([0, *range(m), m - 1] for m in (n + 1, 2 * n + 1))
        for across, ids in enumerate(_place_ids(self.level, self.device).split(5)):
            ids = ids.view(5, n + 1, 2 * n + 1) if across else ids.view(5, 2 * n + 1, n + 1)
            down, right = (wide, high) if across else (high, wide)
            ids = ids[:, down][:, :, right]
            if self.room:
                ids = F.pad(ids, (0, 2, 0, 2))
            for first in range(0, 5, self.together):
                some = ids[first : first + self.together]
                places = hypotheses[:, None, None] * self.vertices + some[:, None]
                yield Some(first, bool(across), places)


class PlaceSum:
    """The sum of every vertex over all its places, group by group: first those down, then those across.

    The first row and the last column of rectangles down belong to the next one; they are kept apart until the end.

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

    def add(self, rectangles: Tensor, some: Some) -> None:
        """Add values ``(g, N, h, w, C)`` at the places of a group."""
        n = self.n
        for k, rectangle in enumerate(rectangles, some.first):
            if not some.across:
                self.charts[:, k] = rectangle[:, 1:, :-1]
                self.top[:, k], self.east[:, k] = rectangle[:, 0], rectangle[:, 1:, -1]
                continue
            self.top[:, k] += rectangle[:, 0, : n + 1]
            self.charts[:, k, :n] += rectangle[:, 1:, :n]
            self.east[:, k, :n] += rectangle[:, 1:, n]
            following = (k + 1) % 5
            self.charts[:, following, n - 1 :, 1:] += rectangle[:, :, n + 1 : -1]
            self.east[:, following, n - 1 :] += rectangle[:, :, -1]

    def total(self) -> Tensor:
        """Values ``(N, V, C)``, once everything is added."""
        n, charts, top, east = self.n, self.charts, self.top, self.east
        self.values[:, 0] = top[:, :, 0].sum(1)
        self.values[:, -1] = east[:, :, -1].sum(1)
        charts[:, :, :n, 0] += top[:, :, 1:].roll(1, 1)
        charts[:, :, n:, 0] += east[:, :, :n].roll(1, 1)
        charts[:, :, -1, 1:] += east[:, :, n:-1].roll(1, 1)
        return self.values

    def mean(self) -> Tensor:
        """Values ``(N, V, C)``: the sums by the number of places."""
        return self.total().mul_(places_per_vertex(self.n, self.values)[:, None].reciprocal_())
