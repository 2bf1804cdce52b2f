# SPDX-License-Identifier: Apache-2.0
"""Costs along paths as one kernel for CUDA devices, in Triton: a program goes along a few paths, from step to step."""

from __future__ import annotations

import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

PATHS = 8
"""Of a program, which is one warp: all hypotheses of a path lie in its registers."""


@triton.jit  # type: ignore[no-untyped-def, unused-ignore]
def _kernel(  # type: ignore[no-untyped-def]
    cost, ids, jumps, result, small_penalty, vertices, paths, number, jump_batch, batches,
    steps: tl.constexpr, first: tl.constexpr, N: tl.constexpr, PATHS: tl.constexpr,
):  # fmt: skip
    path = tl.program_id(0) * PATHS + tl.arange(0, PATHS)
    batch = tl.program_id(1)
    inside = path < paths
    hypothesis = tl.arange(0, N)[:, None]
    within = (hypothesis < number) & inside[None, :]
    # At the ends a hypothesis is its own neighbour: with the penalty that is never the least.
    before = tl.maximum(hypothesis - 1, 0) + tl.zeros((N, PATHS), tl.int32)
    after = tl.minimum(hypothesis + 1, number - 1) + tl.zeros((N, PATHS), tl.int32)
    planes = cost + (batch * number + hypothesis) * vertices
    targets = result + (hypothesis * batches + batch) * (steps - first) * paths + path[None, :]
    vertex = tl.load(ids + path, mask=inside, other=0)
    reached = tl.load(planes + vertex[None, :], mask=within, other=float("inf"))
    for step in range(steps):
        if step > 0:
            vertex = tl.load(ids + step * paths + path, mask=inside, other=0)
            here = tl.load(planes + vertex[None, :], mask=within, other=float("inf"))
            jump = tl.load(
                jumps + ((step - 1) * jump_batch + batch % jump_batch) * paths + path, mask=inside, other=0.0
            )
            above = reached - tl.min(reached, axis=0)[None, :]
            beside = tl.minimum(tl.gather(above, before, 0), tl.gather(above, after, 0)) + small_penalty
            reached = here + tl.minimum(tl.minimum(above, jump[None, :]), beside)
        if step >= first:
            tl.store(targets + (step - first) * paths, reached, mask=within)


def path_costs_kernel(
    cost: Float[Tensor, "B N V"],
    ids: Int[Tensor, "steps P"],
    jumps: Float[Tensor, "steps_after_first B_or_1 P"],
    small_penalty: float,
    first: int,
) -> Float[Tensor, "N B steps_from_first_on P"]:
    """Return the costs of coming along P paths to each of their vertices from the step ``first`` on.

    Args:
        cost: ``(B, N, V)`` float32.
        ids: ``(steps, P)`` vertices along the paths.
        jumps: ``(steps - 1, B or 1, P)`` what a change by more than a hypothesis costs at each step.
        small_penalty: what a change by one costs.
        first: of the steps that are returned.
    """
    cost, jumps = cost.contiguous(), jumps.contiguous()
    batch, number, vertices = cost.shape
    steps, paths = ids.shape
    result = cost.new_empty(number, batch, steps - first, paths)
    _kernel[(triton.cdiv(paths, PATHS), batch)](
        cost, ids, jumps, result, small_penalty, vertices, paths, number, jumps.shape[1], batch,
        steps=steps, first=first, N=triton.next_power_of_2(number), PATHS=PATHS, num_warps=1,
    )  # fmt: skip
    return result
