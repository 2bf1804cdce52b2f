# SPDX-License-Identifier: Apache-2.0
"""Confidence of a sweep: the probability that its index is right to within one hypothesis, from smoothed costs."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.geometry.lookup import read_entries
from sphericalvision.icosphere import level_from_num_vertices
from sphericalvision.sweep.ring_mean import ring_mean, vertex_rings

#: Logistic regression of "error below one hypothesis" on the two features: 42 frames of 12 rendered scenes, level and
#: tilted by 30 degrees, clean, noisy, faint and bare, N = 16, costs at level 5 and tried at every half hypothesis.
BIAS, WEIGHT_OF_MARGIN, WEIGHT_OF_SPREAD = 2.27, 0.5, -1.12

#: Correlation around a vertex below which there is hardly more than noise to compare.
LEAST_CORRELATION = 0.1


def sweep_confidence(
    cost: Float[Tensor, "B M V"],
    correlation: Float[Tensor, "B V"],
    index: Float[Tensor, "B V"],
    substeps: int,
) -> Float[Tensor, "B V"]:
    """Return the probability ``(B, V)`` that an index is less than one hypothesis off.

    It is a logistic regression of two logarithms. The *margin* is the least additional cost of a hypothesis more than
    one and a half away: it is small on bare surfaces. The *spread* is the range of indices within two rings: it is
    large at depth edges, where most of the large errors are. Where the correlation is below that of noise, the
    probability is lowered in proportion.

    Args:
        cost: ``(B, M, V)`` smoothed, of M tried hypotheses.
        correlation: ``(B, V)`` of the best cameras at the index.
        index: ``(B, V)`` in tried hypotheses.
        substeps: tried hypotheses for each hypothesis.

    Examples:
        >>> cost = torch.ones(1, 16, 162)
        >>> index = torch.full((1, 162), 5.0)
        >>> bare = sweep_confidence(cost, torch.zeros(1, 162), index, substeps=1)  # no answer is better than another
        >>> cost[:, 5] = 0
        >>> clear = sweep_confidence(cost, torch.ones(1, 162), index, substeps=1)
        >>> bool(bare.max() < 0.1), bool(clear.min() > 0.9)
        (True, True)
    """
    hypotheses = torch.arange(cost.shape[1], dtype=index.dtype, device=cost.device)[:, None]
    winner = index.round()[:, None]
    at_winner = cost.gather(1, winner.long())
    far = (hypotheses - winner).abs() > 1.5 * substeps
    margin = (cost - at_winner).where(far, torch.inf).amin(1)
    rings = vertex_rings(level_from_num_vertices(cost.shape[-1]), cost.device)
    largest, smallest = index, index
    for _ in range(2):
        largest, smallest = read_entries(largest, rings).amax(-1), read_entries(smallest, rings).amin(-1)
    spread = (largest - smallest) / substeps
    logit = WEIGHT_OF_MARGIN * margin.clamp(1e-6, 1e6).log() + WEIGHT_OF_SPREAD * (spread + 0.15).log()
    contrast = ring_mean(correlation.T).T / LEAST_CORRELATION
    return (BIAS + logit).sigmoid() * contrast.clamp(0, 1)
