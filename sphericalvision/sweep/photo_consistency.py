# SPDX-License-Identifier: Apache-2.0
"""Photo-consistency: a sphere sweep that needs no training, and the baseline for those that do."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.core import ArgumentError
from sphericalvision.geometry.directions import in_single_precision
from sphericalvision.icosphere import Icosphere, level_from_num_vertices
from sphericalvision.icosphere.topology import check_level
from sphericalvision.shapes import check_shapes
from sphericalvision.sweep.appearance import local_appearance
from sphericalvision.sweep.correlation import LEAST_SHARE
from sphericalvision.sweep.hypotheses import check_hypotheses, inverse_depth_hypotheses
from sphericalvision.sweep.regression import DepthEstimate
from sphericalvision.sweep.sphere_sweep import sphere_sweep
from sphericalvision.sweep.sweep_tables import sweep_tables
from sphericalvision.sweep.visibility import check_seen, seen_in_view

if TYPE_CHECKING:
    from sphericalvision.cameras import CameraRig


@check_shapes
def photo_consistency(
    sphere_images: Float[Tensor, "B n 3 V_image"],
    rig: CameraRig,
    num_hypotheses: int,
    min_depth: float,
    level: int | None = None,
    seen: Bool[Tensor, "B n V_image"] | Bool[Tensor, "n V_image"] | None = None,
) -> DepthEstimate:
    """Return, at each vertex, the hypothesis at which the cameras that see the point agree best.

    The cost of a hypothesis is the mean absolute deviation of the cameras' ``local_appearance`` from their
    mean, over those cameras (at least two) whose field of view holds the point. The smallest cost wins; where
    no hypothesis is seen by two cameras the index is 0 (infinity) and the confidence 0.

    Args:
        sphere_images: ``(B, n, 3, V_image)`` in [-1, 1] on icospheres aligned with the world, in the order of
            ``rig.names``.
        rig: of n cameras, for all samples or, with batched poses, a rig a sample.
        num_hypotheses: N.
        min_depth: smallest depth in metres.
        level: of the result; two below the images' when not given, as ``IcoSweepNet`` has it.
        seen: ``([B,] n, V_image)``, True where the images show something; by default the rig's views less its masks.

    Returns:
        Index ``(B, V_level)``, 0 to N - 1; confidence ``(B, V_level)``: 1 minus the ratio of the best to the mean cost;
        and where two cameras see the point at any hypothesis.

    Raises:
        ArgumentError: if the level is above the images'.

    References:
        Collins (1996), "A space-sweep approach to true multi-image matching".

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(2, radius=0.1)
        >>> index, confidence, seen = photo_consistency(torch.rand(1, 2, 3, 642), rig, num_hypotheses=8,
        ...     min_depth=0.5)
        >>> index.shape
        torch.Size([1, 42])
    """
    sphere_images = in_single_precision(sphere_images)
    check_hypotheses(num_hypotheses, min_depth)
    image_level = level_from_num_vertices(sphere_images.shape[-1])
    level = max(image_level - 2, 0) if level is None else check_level(level)
    if level > image_level:
        raise ArgumentError(f"level: expected 0 to {image_level}, the level of the images, got {level}")

    grid = Icosphere(level, sphere_images.dtype, sphere_images.device)
    seen = seen_in_view(rig, image_level).to(sphere_images.device) if seen is None else seen
    seen = check_seen(seen, sphere_images)
    visible = seen.to(sphere_images)[:, :, None]
    features = torch.cat((local_appearance(sphere_images, seen) * visible, visible), 2)
    costs = []
    for inverse_depth in inverse_depth_hypotheses(num_hypotheses, min_depth, device=grid.vertices.device):
        tables = sweep_tables(grid.vertices, inverse_depth[None], rig, image_level)
        values, share = sphere_sweep(features, tables).values.squeeze(3).split((7, 1), 2)
        # As for correlations: a view ends where half of the interpolation weights are out of it.
        costs.append(deviation_cost(values / share.clamp(min=LEAST_SHARE), share.squeeze(2) > LEAST_SHARE))
    cost = torch.stack(costs, 1)
    finite = cost.isfinite()
    mean = torch.where(finite, cost, 0.0).sum(1) / finite.sum(1).clamp(min=1)
    valid = finite.any(1)
    confidence = torch.where(valid, 1 - cost.amin(1) / mean.clamp(min=1e-12), 0.0).clamp(0, 1)
    return DepthEstimate(cost.min(1).indices.to(cost), confidence, valid)


def deviation_cost(values: Float[Tensor, "B n C V"], seen: Bool[Tensor, "B n V"]) -> Float[Tensor, "B V"]:
    """Return the mean absolute deviation ``(B, V)`` of cameras' values ``(B, n, C, V)``, seen where ``(B, n, V)``.

    Infinite where fewer than two cameras see the point.

    Examples:
        >>> values = torch.tensor([[[[1.0]], [[3.0]]]])  # two cameras, one channel, one vertex
        >>> deviation_cost(values, torch.ones(1, 2, 1, dtype=torch.bool))  # the standard deviation
        tensor([[1.4142]])
    """
    counts = seen[:, :, None].to(values.dtype)
    count = counts.sum(1)
    mean = (values * counts).sum(1) / count.clamp(min=1)
    deviation = ((values - mean[:, None]).abs() * counts).sum(1) / count.clamp(min=1)
    # The deviation of k samples from their own mean is too small on average by this factor; without it, two
    # cameras would always agree better than three.
    unbiased = (count / (count - 1).clamp(min=1)).sqrt().squeeze(1)
    return torch.where(count.squeeze(1) >= 2, deviation.mean(1) * unbiased, torch.inf)
