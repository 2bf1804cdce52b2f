# SPDX-License-Identifier: Apache-2.0
"""From one level of the icosphere to the next: which edge a vertex halves."""

from __future__ import annotations

import torch
from jaxtyping import Int
from torch import Tensor

from sphericalvision.icosphere.topology import check_level, vertex_at
from sphericalvision.tables import constant_table, copied


@copied
@constant_table
def icosphere_vertex_parents(level: int, device: torch.device | str | None = None) -> Int[Tensor, "V 2"]:
    """Return the two vertices of the next coarser level whose edge each vertex halves, ``(V, 2)``.

    Vertices that the coarser level has too come from one vertex, which is given twice; their ids in this level are
    ``coarse_vertex_ids``.

    Examples:
        >>> icosphere_vertex_parents(1)[:3].tolist()  # the north pole, and two vertices next to it
        [[0, 0], [0, 1], [1, 3]]
    """
    n = 2 ** check_level(level, 1)
    chart = torch.arange(5, device=device)[:, None, None]
    row = torch.arange(1, 2 * n + 1, device=device)[:, None]
    column = torch.arange(n, device=device)
    # Edges run along rows, along columns and, where row and column are both odd, from lower left to upper right.
    odd_row, odd_column = row % 2, column % 2
    first = vertex_at(chart, (row + odd_row) // 2, (column - odd_column) // 2, level - 1)
    second = vertex_at(chart, (row - odd_row) // 2, (column + odd_column) // 2, level - 1)
    parents = torch.stack((first, second), -1).view(-1, 2).sort(-1).values
    last = 10 * (n // 2) ** 2 + 1
    return torch.cat((parents.new_zeros(1, 2), parents, parents.new_full((1, 2), last)))
