# SPDX-License-Identifier: Apache-2.0
"""Means over a vertex of an icosphere and its neighbours, the windows of correlation."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sphericalvision.geometry.lookup import weighted_rows
from sphericalvision.icosphere import icosphere_neighbors, level_from_num_vertices, num_icosphere_vertices
from sphericalvision.icosphere.locator import chunk_size
from sphericalvision.icosphere.topology import coarse_vertex_ids
from sphericalvision.tables import constant_table


def ring_mean(values: Float[Tensor, " V *rest"], level: int | None = None) -> Float[Tensor, " V_level *rest"]:
    """Average values ``(V, *)`` over each vertex of an icosphere and its neighbours.

    Vertices come first, unlike elsewhere, so that each is one contiguous row.

    Args:
        values: on an icosphere.
        level: of the result, up to that of the values; theirs when not given. Neighbours are always those on the
            icosphere of the values.

    Examples:
        >>> peak = torch.zeros(42, 1)
        >>> peak[0] = 6.0  # the north pole, which has five neighbours
        >>> ring_mean(peak)[:2].flatten()
        tensor([1.0000, 0.8571])
        >>> ring_mean(peak, level=0).shape
        torch.Size([12, 1])
    """
    own_level = level_from_num_vertices(len(values))
    ids, weights = _rings(own_level, own_level if level is None else level, values.device)
    return weighted_rows(values.flatten(1), ids, weights).view(len(ids), *values.shape[1:])


def coarser_images(
    images: Float[Tensor, "B n C V"], seen: Bool[Tensor, "B n V"]
) -> tuple[Float[Tensor, "B n C V_coarse"], Bool[Tensor, "B n V_coarse"]]:
    """Return images on the next coarser icosphere, means over the seen vertices of a ring, and their ``seen``.

    Examples:
        >>> images, seen = coarser_images(torch.ones(1, 2, 3, 162), torch.ones(1, 2, 162, dtype=torch.bool))
        >>> images.shape, images.unique(), seen.all()
        (torch.Size([1, 2, 3, 42]), tensor([1.]), tensor(True))
    """
    level = level_from_num_vertices(images.shape[-1])
    size, rows = chunk_size(images.device) // 8, []  # vertices at once, which stay in the cache of a CPU
    for image, visible in zip(images.split(size, -1), seen[:, :, None].split(size, -1), strict=True):
        visible = visible.to(image)
        # As matrices: torch transposes these several times as fast as it permutes four dimensions.
        rows.append(torch.cat((image * visible, visible), 2).flatten(0, 2).t())
    means = ring_mean(torch.cat(rows), level - 1).t().contiguous().unflatten(0, (*images.shape[:2], -1))
    coarse_seen = seen[..., ids_of_coarser_level(level, level - 1, images.device)]
    values = means[:, :, :-1] / means[:, :, -1:].clamp(min=1e-6)
    return values * coarse_seen[:, :, None], coarse_seen


@constant_table
def ids_of_coarser_level(
    level: int, coarser: int, device: torch.device | str | None = None
) -> Int[Tensor, " V"]:
    """Return the ids at ``level`` of the vertices of a coarser icosphere, or of the same one.

    Examples:
        >>> ids_of_coarser_level(2, 0)[:3]
        tensor([ 0, 13, 29])
    """
    ids = torch.arange(num_icosphere_vertices(coarser), device=device)
    for finer in range(coarser + 1, level + 1):
        ids = coarse_vertex_ids(finer, device)[ids]
    return ids


@constant_table
def vertex_rings(level: int, device: torch.device) -> Int[Tensor, "V 7"]:
    """Return the ids of each vertex and its neighbours, ``(V, 7)``; one with five neighbours stands there twice."""
    ids = torch.arange(num_icosphere_vertices(level), device=device)[:, None]
    neighbors = icosphere_neighbors(level, device)
    return torch.cat((ids, torch.where(neighbors < 0, ids, neighbors)), 1)


@constant_table
def _rings(level: int, coarser: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Ids ``(V, 7)`` of a coarser level's vertices and their neighbours, and the share of each in the mean."""
    own = ids_of_coarser_level(level, coarser, device)[:, None]
    neighbors = icosphere_neighbors(level, device)[own[:, 0]]
    present = torch.cat((own, neighbors), 1) >= 0
    weights = present / present.sum(1, keepdim=True).to(torch.float64)
    return torch.cat((own, neighbors.clamp(min=0)), 1), weights
