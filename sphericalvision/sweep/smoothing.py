# SPDX-License-Identifier: Apache-2.0
"""Semi-global smoothing on the icosphere: costs summed up along its straight lines, both ways."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError, constant_table, is_recording
from sphericalvision.geometry.means_by_id import MeansById, mean_by_id, means_by_id
from sphericalvision.icosphere import level_from_num_vertices, num_icosphere_vertices
from sphericalvision.icosphere.lines import icosphere_lines

__all__ = ["semi_global_smoothing", "smoothing_paths"]


def semi_global_smoothing(
    cost: Float[Tensor, "B N V"],
    small_penalty: float,
    large_penalty: float,
    guide: Float[Tensor, "B C V"] | None = None,
    contrast: float = 0.1,
    lead: float = 1.0,
) -> Float[Tensor, "B N V"]:
    """Add to the cost of each hypothesis what it takes to reach it along the straight lines through a vertex.

    A path comes to vertex p from its predecessor q on the line with ``L(p, i) = C(p, i) + min(L(q, i),
    L(q, i - 1) + P1, L(q, i + 1) + P1, min L(q) + P2) - min L(q)``: no penalty for the same hypothesis, P1 for the
    next one, P2 for any other. Paths come from all six directions (five at the twelve vertices where lines end),
    across the seams of the icosphere as anywhere else, and the result is their mean.

    Args:
        cost: ``(B, N, V)``, finite.
        small_penalty: P1, for a change by one hypothesis.
        large_penalty: P2, for any larger change, where the guide does not change.
        guide: ``(B, C, V)`` colours: P2 is divided by ``1 + |change of colour| / contrast`` (but never below
            P1), because surfaces end where colours do.
        contrast: change of colour that halves P2, in the unit of the guide (mean over channels).
        lead: vertices that a path passes before the first of its results, as multiples of an edge of the
            icosahedron; lines run around the sphere in 5. Paths along such an edge start at its end.

    Returns:
        ``(B, N, V)``; the best hypothesis is the smallest.

    Raises:
        ShapeError: if the cost is not on an icosphere or the guide does not fit.
        ArgumentError: unless 0 <= P1 <= P2, the contrast is positive, and the lead 0 to 4.

    References:
        Hirschmüller (2008), "Stereo processing by semiglobal matching and mutual information", section 2.3.

    Examples:
        >>> cost = torch.rand(1, 8, 642, generator=torch.Generator().manual_seed(0))
        >>> cost[:, 3] -= 0.3
        >>> alone, smooth = cost.argmin(1), semi_global_smoothing(cost, 1.0, 4.0).argmin(1)
        >>> bool((alone == 3).float().mean() < 0.5), bool((smooth == 3).float().mean() > 0.99)
        (True, True)
    """
    if cost.ndim != 3:
        raise ShapeError(f"cost: expected shape (B, N, V), got {tuple(cost.shape)}")
    level = level_from_num_vertices(cost.shape[-1])
    if not 0 <= small_penalty <= large_penalty:
        raise ArgumentError(
            f"small_penalty, large_penalty: expected 0 <= P1 <= P2, got {small_penalty} and {large_penalty}"
        )
    if not contrast > 0:
        raise ArgumentError(f"contrast: expected a positive number, got {contrast}")
    if guide is not None and (guide.ndim != 3 or guide.shape[::2] != cost.shape[::2]):
        expected = f"({cost.shape[0]}, C, {cost.shape[2]})"
        raise ShapeError(f"guide: expected shape {expected}, got {tuple(guide.shape)}")
    planes = cost.transpose(0, 1)  # (N, B, V): a step compares whole planes of all paths at once
    if is_recording():
        along = [
            _scanned(planes, guide, paths, first, small_penalty, large_penalty, contrast)
            for paths, first in smoothing_paths(level, lead, cost.device)
        ]
        return mean_by_id(torch.cat(along, 2), _arrivals(level, lead, cost.device)).transpose(0, 1)
    total, count = torch.zeros_like(planes), planes.new_zeros(planes.shape[-1])
    for paths, first in smoothing_paths(level, lead, cost.device):
        ids, shape = paths.flatten(), (*planes.shape[:2], *paths.shape)
        steps = planes.index_select(2, ids).view(shape).unbind(2)
        jumps = _jump_penalties(guide, paths, small_penalty, large_penalty, contrast)
        reached = [steps[0]]
        for step in range(1, len(paths)):
            reached.append(_extended(reached[-1], steps[step], small_penalty, jumps[step - 1]))
        arrived = torch.stack(reached[first:], 2).flatten(2)
        ids = paths[first:].flatten()
        total = total.index_add(2, ids, arrived)
        count.index_add_(0, ids, count.new_ones(len(ids)))
    return (total / count).transpose(0, 1)


def _scanned(
    planes: Tensor,
    guide: Tensor | None,
    paths: Tensor,
    first: int,
    small_penalty: float,
    large_penalty: float,
    contrast: float,
) -> Tensor:
    """Costs ``(N, B, P')`` along paths from step ``first`` on, by a loop that is one operation to who records it."""
    from torch._higher_order_ops.scan import scan_op  # takes a second, and only who exports pays it

    steps = planes.index_select(2, paths.flatten()).unflatten(2, tuple(paths.shape)).movedim(2, 0)
    penalties = _jump_penalties(guide, paths, small_penalty, large_penalty, contrast)
    jumps = torch.stack([torch.as_tensor(jump, dtype=steps.dtype, device=steps.device) for jump in penalties])

    def extend(reached: Tensor, cost: Tensor, jump: Tensor) -> tuple[Tensor, Tensor]:
        reached = _extended(reached, cost, small_penalty, jump)
        return in_order(reached), in_order(reached)

    def in_order(values: Tensor) -> Tensor:
        """A copy, in the one layout in memory that compilers ask of what goes round a loop."""
        return values.clone(memory_format=torch.contiguous_format)

    _, reached = scan_op(extend, [in_order(steps[0])], [in_order(steps[1:]), in_order(jumps)], ())
    reached = torch.cat((steps[:1], reached))[first:]
    return reached.movedim(0, 2).flatten(2)


@constant_table
def _arrivals(level: int, lead: float, device: torch.device) -> MeansById:
    """Which of the costs along all paths are those of a vertex."""
    ids = [paths[first:].flatten() for paths, first in smoothing_paths(level, lead, device)]
    return means_by_id(torch.cat(ids), num_icosphere_vertices(level))


def _extended(reached: Tensor, cost: Tensor, small_penalty: float, jump: Tensor | float) -> Tensor:
    """Costs ``(N, B, P)`` of P paths extended by a vertex of costs ``(N, B, P)``."""
    best = reached.amin(0)
    beside = F.pad(reached + small_penalty, (0, 0, 0, 0, 1, 1), value=torch.inf)
    least = torch.minimum(torch.minimum(reached, best + jump), torch.minimum(beside[:-2], beside[2:]))
    return cost + (least - best)


def _jump_penalties(
    guide: Tensor | None, paths: Tensor, small_penalty: float, large_penalty: float, contrast: float
) -> Sequence[Tensor | float]:
    """P2 of each step of paths ``(steps, P)``: a number, or ``(B, P)`` of a guide ``(B, C, V)``."""
    if guide is None:
        return [large_penalty] * (len(paths) - 1)
    colors = guide.index_select(2, paths.flatten()).unflatten(2, paths.shape)
    change = (colors[:, :, 1:] - colors[:, :, :-1]).abs().mean(1)
    return (large_penalty / (1 + change / contrast)).clamp(min=small_penalty).unbind(1)


@lru_cache(maxsize=8)
@torch.inference_mode(False)  # what is kept must be usable where gradients are wanted
def smoothing_paths(
    level: int, lead: float = 1.0, device: torch.device | str | None = None
) -> tuple[tuple[Int[Tensor, "steps P"], int], tuple[Int[Tensor, "steps_along_edges P_along_edges"], int]]:
    """Return vertex ids along paths, step by step ``(steps, P)``, and the step from which their results count.

    Closed lines are cut into fifths where they cross certain edges of the icosahedron, which its rotations (72
    degrees about the vertical among them) take to one another; so they do with the paths.
    """
    if not 0 <= lead <= 4:
        raise ArgumentError(f"lead: expected 0 to 4 edges of the icosahedron, got {lead}")
    size = 2**level
    ahead = round(lead * size)
    loops, edges = icosphere_lines(level, device)
    columns = torch.arange(-ahead, size, device=device)[:, None] + torch.arange(5, device=device) * size
    # Backwards, a fifth starts at the same edge of the icosahedron.
    both = torch.cat((loops[:, columns % (5 * size)], loops[:, -columns % (5 * size)]))
    ends = torch.cat((edges, edges.flip(1)))
    return (both.transpose(0, 1).flatten(1), ahead), (ends.T.contiguous(), 1)
