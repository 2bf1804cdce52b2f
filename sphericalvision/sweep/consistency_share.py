# SPDX-License-Identifier: Apache-2.0
"""Quality of a depth map without truth: the correlation of the cameras at it, as a share of the greatest possible."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.core import ShapeError
from sphericalvision.icosphere import level_from_num_vertices
from sphericalvision.shapes import check_shapes
from sphericalvision.sweep.correlation import correlation_evidence
from sphericalvision.sweep.ring_mean import ids_of_coarser_level
from sphericalvision.sweep.semi_global import SemiGlobalTables, check_tables, semi_global_tables
from sphericalvision.sweep.winner import at_nearest_hypothesis

if TYPE_CHECKING:
    from sphericalvision.cameras import CameraRig


@torch.no_grad()
@check_shapes
def photo_consistency_share(
    index: Float[Tensor, "B V"],
    sphere_images: Float[Tensor, "B n 3 V_image"],
    rig: CameraRig | SemiGlobalTables,
    num_hypotheses: int,
    min_depth: float,
    seen: Bool[Tensor, "B n V_image"] | Bool[Tensor, "n V_image"] | None = None,
) -> Float[Tensor, " B"]:
    """Return the photo-consistency of a depth map, as a share of that of winner-takes-all, 0 to 1.

    It is the correlation of the better half of the pairs of cameras (``correlation_evidence``), summed over the sphere:
    that at the depth divided by the greatest over all hypotheses. Exposure does not matter. Winner-takes-all fits
    noise, too, so 1 is no aim. Of two depth maps of the same images, made in the same way, the one with the greater
    share is better, unless nothing has texture.

    Args:
        index: ``(B, V)``, 0 to N - 1, on an icosphere up to the level of the images.
        sphere_images: ``(B, n, 3, V_image)`` in [-1, 1] of two or more cameras, in the order of ``rig.names``.
        rig: of all samples or, with batched poses, a rig a sample; or ``semi_global_tables`` of either.
        num_hypotheses: N, which the index is counted in.
        min_depth: of hypothesis N - 1 in metres.
        seen: ``([B,] n, V_image)``, True where the images show something; by default the rig's views less its masks.

    Returns:
        ``(B,)``; NaN where no two cameras see anything in common.

    Raises:
        ShapeError: if images and index do not fit.

    References:
        Goesele et al. (2007), "Multi-view stereo for community photo collections", section 6 (correlation of the best
        views).

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.sweep import photo_consistency
        >>> images = torch.rand(1, 4, 3, 642, generator=torch.Generator().manual_seed(0)) * 2 - 1
        >>> rig = ring_rig(4)
        >>> found = photo_consistency(images, rig, num_hypotheses=8, min_depth=0.5, level=2)
        >>> shares = [photo_consistency_share(x, images, rig, 8, 0.5) for x in (found.index, 7 - found.index)]
        >>> bool(shares[0] > shares[1])
        True
    """
    level, image_level = (level_from_num_vertices(x.shape[-1]) for x in (index, sphere_images))
    if level > image_level:
        raise ShapeError(f"index: expected level {image_level} or less, that of the images, got {level}")
    if isinstance(rig, SemiGlobalTables):
        tables = rig
        check_tables(tables.seen, sphere_images)
    else:
        cost_level = min(level, max(image_level - 1, 0))
        device = sphere_images.device
        tables = semi_global_tables(rig, num_hypotheses, min_depth, image_level, cost_level, device=device)
    evidence = correlation_evidence(sphere_images, tables.sweep, tables.seen if seen is None else seen)
    _, best, cameras = evidence.unbind(1)
    ids = ids_of_coarser_level(level, level_from_num_vertices(best.shape[-1]), index.device)
    return consistency_share(index[:, ids] / (num_hypotheses - 1), best, cameras >= 2)


def consistency_share(
    place: Float[Tensor, "B V"], correlation: Float[Tensor, "B M V"], known: Bool[Tensor, "B M V"]
) -> Float[Tensor, " B"]:
    """Return the share ``(B,)`` from correlations at M tried hypotheses; two cameras see those that are ``known``.

    Args:
        place: ``(B, V)`` the depth: 0 the first of the tried hypotheses, 1 the last.
        correlation: ``(B, M, V)``.
        known: ``(B, M, V)``.

    Examples:
        >>> correlation = torch.tensor([0.0, 0.5, 1.0]).view(1, 3, 1)
        >>> consistency_share(torch.tensor([[0.75]]), correlation, correlation >= 0)
        tensor([0.7500])
    """
    hypothesis = place.clamp(0, 1) * (correlation.shape[1] - 1)
    lower = hypothesis.floor().clamp(max=correlation.shape[1] - 2)
    below, above = (at_nearest_hypothesis(correlation, lower + step) for step in (0, 1))
    reached = below + (hypothesis - lower) * (above - below)
    counts = at_nearest_hypothesis(known, hypothesis)
    most = correlation.where(known, 0.0).amax(1)
    return (reached * counts).sum(1) / (most * counts).sum(1)
