# SPDX-License-Identifier: Apache-2.0
"""Semi-global smoothing on the icosphere: costs summed up along its straight lines, both ways."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sphericalvision.core import ArgumentError
from sphericalvision.geometry.directions import in_single_precision
from sphericalvision.geometry.lookup import read_entries
from sphericalvision.geometry.means_by_id import MeansById, mean_by_id, means_by_id
from sphericalvision.icosphere import level_from_num_vertices, num_icosphere_vertices
from sphericalvision.icosphere.lines import icosphere_lines
from sphericalvision.kernels import Operator
from sphericalvision.shapes import check_shapes
from sphericalvision.tables import constant_table


@check_shapes
def semi_global_smoothing(
    cost: Float[Tensor, "B N V"],
    small_penalty: float,
    large_penalty: float,
    guide: Float[Tensor, "B C V"] | None = None,
    contrast: float = 0.1,
) -> Float[Tensor, "B N V"]:
    """Return the mean cost of each hypothesis over the paths that come to a vertex along its straight lines.

    A path comes to vertex p from its predecessor q on the line with ``L(p, i) = C(p, i) + min(L(q, i),
    L(q, i - 1) + P1, L(q, i + 1) + P1, min L(q) + P2) - min L(q)``: no penalty for the same hypothesis, P1 for the
    next one, P2 for any other. Paths come from all six directions (five at the twelve vertices where lines end), also
    across the seams of the icosphere.

    Args:
        cost: ``(B, N, V)``, finite.
        small_penalty: P1, for a change by one hypothesis.
        large_penalty: P2, for any larger change, where the guide does not change.
        guide: ``(B, C, V)`` colours: P2 is divided by ``1 + |change of colour| / contrast`` (but never below
            P1), because surfaces end where colours do.
        contrast: change of colour that halves P2, in the unit of the guide (mean over channels).

    Returns:
        ``(B, N, V)`` in float32 at least; the best hypothesis is the smallest.

    Raises:
        ShapeError: if the cost is not on an icosphere or the guide does not fit.
        ArgumentError: unless 0 <= P1 <= P2 and the contrast is positive.

    References:
        Hirschmüller (2008), "Stereo processing by semiglobal matching and mutual information", section 2.3.

    Examples:
        >>> cost = torch.rand(1, 8, 642, generator=torch.Generator().manual_seed(0))
        >>> cost[:, 3] -= 0.3
        >>> alone, smooth = cost.argmin(1), semi_global_smoothing(cost, 1.0, 4.0).argmin(1)
        >>> bool((alone == 3).float().mean() < 0.5), bool((smooth == 3).float().mean() > 0.99)
        (True, True)
    """
    level = level_from_num_vertices(cost.shape[-1])
    if not 0 <= small_penalty <= large_penalty:
        raise ArgumentError(
            f"small_penalty, large_penalty: expected 0 <= P1 <= P2, got {small_penalty} and {large_penalty}"
        )
    if not contrast > 0:
        raise ArgumentError(f"contrast: expected a positive number, got {contrast}")
    paths = smoothing_paths(level, cost.device)
    jumps = _jump_penalties(guide, paths, small_penalty, large_penalty, contrast)
    return _path_means(in_single_precision(cost), jumps, small_penalty, paths)


def _means_by_adding(cost: Tensor, jumps: Tensor, small_penalty: float, paths: SmoothingPaths) -> Tensor:
    """Mean ``(B, N, V)`` over the paths that come to a vertex, by ``index_add``: on a CPU faster than lookups."""
    results = _along_paths(cost, jumps, small_penalty, paths, _extended)
    total = cost.new_zeros(cost.transpose(0, 1).shape)
    for lines in paths.kinds:
        arrived = torch.stack([result[..., lines] for result in results], 2).flatten(2)
        total = total.index_add(2, paths.ids[paths.first :, lines].flatten(), arrived)
    return (total / paths.counts.to(total)).transpose(0, 1)


def _means_by_lookups(cost: Tensor, jumps: Tensor, small_penalty: float, paths: SmoothingPaths) -> Tensor:
    results = _along_paths(cost, jumps, small_penalty, paths, _extended_in_few_steps)
    return mean_by_id(torch.stack(results, 2).flatten(2), paths.arrivals).transpose(0, 1)


def _means_in_triton(cost: Tensor, jumps: Tensor, small_penalty: float, paths: SmoothingPaths) -> Tensor:
    if cost.dtype != torch.float32 or jumps.dtype != torch.float32:
        return NotImplemented
    from sphericalvision.sweep.smoothing_triton import path_costs_kernel  # Triton is not everywhere

    arrived = path_costs_kernel(cost, paths.ids, jumps, small_penalty, paths.first)
    return mean_by_id(arrived.flatten(2), paths.arrivals).transpose(0, 1)


_path_means = Operator(_means_by_adding, triton=_means_in_triton, fused=_means_by_lookups)


def _along_paths(
    cost: Tensor,
    jumps: Tensor,
    small_penalty: float,
    paths: SmoothingPaths,
    extend: Callable[[Tensor, Tensor, float, Tensor], Tensor],
) -> list[Tensor]:
    """Costs ``(N, B, P)`` of all P paths at each step whose results count."""
    planes = cost.transpose(0, 1)  # (N, B, V): a step compares whole planes of all paths at once
    # One step more than needed: planes multiples of 4096 bytes apart would evict each other from the cache.
    ids = torch.cat((paths.ids, paths.ids[:1]))
    *steps, _ = read_entries(planes, ids).unbind(2)
    reached = [steps[0]]
    for step, jump in zip(steps[1:], jumps.unbind(), strict=True):
        reached.append(extend(reached[-1], step, small_penalty, jump))
    return reached[paths.first :]


def _extended(reached: Tensor, cost: Tensor, small_penalty: float, jump: Tensor) -> Tensor:
    """Costs ``(N, B, P)`` of P paths extended by a vertex of costs ``(N, B, P)``."""
    best = reached.amin(0)
    return cost + (_least(reached, small_penalty, best + jump) - best)


def _extended_in_few_steps(reached: Tensor, cost: Tensor, small_penalty: float, jump: Tensor) -> Tensor:
    """The same but for rounding, with one operator less a step."""
    return cost + _least(reached - reached.amin(0), small_penalty, jump)


def _least(reached: Tensor, small_penalty: float, jump: Tensor) -> Tensor:
    """Least costs ``(N, B, P)`` of coming to a hypothesis from itself, from its neighbours, or by a jump."""
    # At the ends a hypothesis is its own neighbour: with P1 added that is never the least.
    ends = torch.cat((reached[:1], reached, reached[-1:]))
    neighbor = torch.minimum(ends[:-2], ends[2:]) + small_penalty
    return torch.minimum(torch.minimum(reached, jump), neighbor)


def _jump_penalties(
    guide: Tensor | None, paths: SmoothingPaths, small_penalty: float, large_penalty: float, contrast: float
) -> Tensor:
    """P2 of each step, ``(steps - 1, 1, P)``, or ``(steps - 1, B, P)`` of a guide; zero before a path starts."""
    if guide is None:
        return (paths.begun * large_penalty).unsqueeze(1)
    colors = read_entries(guide, paths.ids)
    change = (colors[:, :, 1:] - colors[:, :, :-1]).abs().mean(1)
    penalty = (large_penalty / (1 + change / contrast)).clamp(min=small_penalty)
    return (penalty * paths.begun.to(penalty)).transpose(0, 1)


class SmoothingPaths(NamedTuple):
    """Vertices along P paths of equal length.

    Attributes:
        ids: ``(steps, P)``; a path that starts later stays at its first vertex until then.
        begun: ``(steps - 1, P)`` 1 where a step leads on, 0 before a path starts: a jump without penalty forgets all
            costs so far.
        first: the step from which results count.
        kinds: the paths of loops, and those of edges.
        counts: ``(V,)`` number of results of a vertex.
        arrivals: the results of each vertex.
    """

    ids: Int[Tensor, "steps P"]
    begun: Float[Tensor, "steps_after_first P"]
    first: int
    kinds: tuple[slice, slice]
    counts: Float[Tensor, " V"]
    arrivals: MeansById


@constant_table
def smoothing_paths(level: int, device: torch.device) -> SmoothingPaths:
    """Return vertex ids along paths, step by step.

    Closed lines are cut into fifths where they cross certain edges of the icosahedron, which its rotations (72
    degrees about the vertical among them) take to one another; so they do with the paths. A path passes as many
    vertices before the first of its results as there are along such an edge; one along an edge starts at its end.
    """
    size = 2**level
    loops, edges = icosphere_lines(level, device)
    columns = torch.arange(-size, size, device=device)[:, None] + torch.arange(5, device=device) * size
    # Backwards, a fifth starts at the same edge of the icosahedron.
    fifths = torch.cat((loops[:, columns % (5 * size)], loops[:, -columns % (5 * size)]))
    kinds = fifths.transpose(0, 1).flatten(1), torch.cat((edges, edges.flip(1))).T
    length = max(map(len, kinds))
    waits = [length - len(ids) for ids in kinds]
    ids = torch.cat(
        [torch.cat((ids[:1].expand(wait, -1), ids)) for ids, wait in zip(kinds, waits, strict=True)], 1
    )
    step = torch.arange(length - 1, device=device)[:, None]
    begun = torch.cat(
        [(step >= wait).expand(-1, ids.shape[1]) for ids, wait in zip(kinds, waits, strict=True)], 1
    )
    first = length - size
    ends, along_loops = ids[first:].flatten(), kinds[0].shape[1]
    number = num_icosphere_vertices(level)
    return SmoothingPaths(
        ids,
        begun.to(torch.float32),
        first,
        (slice(along_loops), slice(along_loops, None)),
        ends.bincount(minlength=number).to(torch.float32),
        means_by_id(ends, number),
    )
