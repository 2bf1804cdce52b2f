# SPDX-License-Identifier: Apache-2.0
"""Simulated hints of depth, made from the truth, for training networks that take hints."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.data.augmentation.fivefold import rotate_fivefold
from sphericalvision.icosphere import icosphere_upsample, level_from_num_vertices, num_icosphere_vertices
from sphericalvision.sweep import DepthHint
from sphericalvision.sweep.ring_mean import ids_of_coarser_level, ring_mean

NONSENSE, SPARSE, SINGLE, HOLED = 0.25, 0.3, 0.3, 0.5
"""Shares of the hints: of another scene; of single points; of one camera alone; with holes."""
SCALE, SHIFT = 0.06, 0.03
"""Deviation of a view's scale, and of its shift in parts of the mean inverse depth."""
ERRORS = 0.02, 0.15
"""Relative error of a hint, least and most."""
DENSITIES = 0.002, 0.1
"""Share of the vertices that have a point, least and most."""
COARSE = 3
"""Level of the icosphere on which errors that hold together lie."""


def simulated_hint(
    inverse_depth: Float[Tensor, "B V"],
    valid: Bool[Tensor, "B V"],
    seen: Bool[Tensor, "B n V_image"] | None = None,
    generator: torch.Generator | None = None,
    share: float = 0.35,
) -> DepthHint:
    """Return a hint ``(B, V)`` for each sample, of weight 0 everywhere in most of them.

    Its errors are those of real hints. Each camera's view is scaled and shifted a little, as by a monocular network
    that was fitted to the sweep. Edges are blurred. Errors of up to 15 % are partly smooth and partly independent from
    vertex to vertex, and the larger they are the lower is the weight. There are holes, or only the view of one camera,
    or single points as of a LiDAR. Mirrors and bare walls have their true depth. One hint in four is of another sample,
    turned, with the same weights.

    Args:
        inverse_depth: ``(B, V)`` true, in 1/m, on an icosphere.
        valid: ``(B, V)`` where that is known.
        seen: ``(B, n, V_image)`` what each camera sees, on the same icosphere or a finer one; without it there is one
            view of all.
        generator: of the values' device.
        share: of the samples that have a hint.

    Examples:
        >>> truth, generator = torch.full((8, 162), 0.5), torch.Generator().manual_seed(0)
        >>> hint = simulated_hint(truth, truth > 0, generator=generator)
        >>> hint.weight.shape, (hint.weight.amax(1) > 0).sum()
        (torch.Size([8, 162]), tensor(5))
    """
    batch, device = len(inverse_depth), inverse_depth.device
    level = level_from_num_vertices(inverse_depth.shape[-1])

    def uniform(*shape: int) -> Tensor:
        return torch.rand(batch, *shape, generator=generator, device=device)

    def normal(*shape: int) -> Tensor:
        return torch.randn(batch, *shape, generator=generator, device=device)

    def between(least: float, most: float, share: Tensor) -> Tensor:
        """Numbers evenly spread in their logarithm."""
        return (math.log(least) + share * math.log(most / least)).exp()

    fractions = uniform(8).split(1, 1)  # of what a sample has once
    nonsense, sparse, single, holed, present = (
        value < most for value, most in zip(fractions, (NONSENSE, SPARSE, SINGLE, HOLED, share), strict=False)
    )
    blur, error, density = fractions[5], between(*ERRORS, fractions[6]), between(*DENSITIES, fractions[7])
    fields = normal(2, num_icosphere_vertices(min(COARSE, level)))
    for _ in range(COARSE, level):
        fields = icosphere_upsample(fields)
    smooth_error, smooth_holes = fields.unbind(1)

    turned = rotate_fivefold(inverse_depth.roll(1, 0), 2), rotate_fivefold(valid.roll(1, 0), 2)
    values = turned[0].where(nonsense, inverse_depth)
    has_depth = turned[1].where(nonsense, valid)
    values = values.where(has_depth, 0.0)

    cameras = inverse_depth.new_ones(batch, 1, values.shape[-1])
    if seen is not None:
        ids = ids_of_coarser_level(level_from_num_vertices(seen.shape[-1]), level, device)
        cameras = seen[..., ids].to(values)
    # In each direction the camera with the largest random number among those that see it gives the depth.
    order = cameras * (uniform(cameras.shape[1], 1) + 0.01)
    greatest, view = order.max(1)
    mean = values.sum(1, keepdim=True) / has_depth.sum(1, keepdim=True).clamp(min=1)
    scale, shift = normal(2, cameras.shape[1]).unbind(1)
    scale, shift = (SCALE * scale).exp().gather(1, view), (SHIFT * shift).gather(1, view) * mean

    rows = torch.stack((values, has_depth.to(values)), -1).transpose(0, 1)
    sums, weights = ring_mean(ring_mean(rows)).transpose(0, 1).unbind(-1)
    blurred = values.lerp(sums / weights.clamp(min=1e-6), blur)
    dense = (blurred * scale * (error * smooth_error).exp() + shift).clamp(min=0)
    values = values.where(sparse, dense) * (0.5 * error * normal(values.shape[-1])).exp()

    points = uniform(values.shape[-1]) < density
    has_depth = has_depth & (points | ~sparse) & ((smooth_holes > -0.5) | ~holed)
    of_one = greatest == greatest.amax(1, keepdim=True)  # the camera that comes before all others
    has_depth = has_depth & (greatest > 0) & (of_one | ~single) & present
    weight = (1 - 4 * error + 0.15 * normal(1)).clamp(0.1, 1)
    return DepthHint(values, weight * has_depth)
