# SPDX-License-Identifier: Apache-2.0
"""Scales of views whose depth is known up to a factor each: the factors with which the views agree where they overlap.

View i has log depth x_iv at place v of the target, with weight w_iv (0 where it shows nothing). The s_i make least

    E(s) = Σ_v Σ_i w_iv (x_iv + s_i - m_v)²,   m_v = Σ_j f_jv (x_jv + s_j),   f_jv = w_jv / Σ_k w_kv,

the weighted squares of deviations from the mean of all views. Setting the derivative by each s_i to zero gives the
normal equations L s = d with

    L_ij = δ_ij Σ_v w_iv - Σ_v w_iv f_jv,      d_i = Σ_v w_iv (Σ_j f_jv x_jv - x_iv).

L is a graph Laplacian: its edges are the overlaps of two views, and its rows sum to zero. So s is determined up to a
constant for each group of connected views; the pseudo-inverse takes that of mean zero, which keeps the geometric mean.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.sphere.resampling.merge import cauchy_weights, mean_and_squares

_ROUNDS = 10  # of weighting by agreement


def log_scales(
    values: Float[Tensor, " n *values"], weights: Float[Tensor, " n *weights"], dims: int
) -> Float[Tensor, " n *scales"]:
    """Return the summand of each view's logarithms with which they agree, 0 on average.

    Args:
        values: ``(n, *b, 1, *target)``, logarithms of depth.
        weights: ``(n, *b, 1, *target)``, 0 where a view shows nothing.
        dims: dimensions of the target.
    """
    # (*b, n, V), in double precision: two views may overlap in few pixels only, and L is then nearly singular.
    flat, flat_weights = (tensor.flatten(-1 - dims).movedim(0, -2).double() for tensor in (values, weights))
    scales, trust = torch.zeros_like(flat[..., :1]), flat_weights
    for _ in range(_ROUNDS):
        total = trust.sum(-2, keepdim=True)
        fractions = trust / torch.where(total > 0, total, 1.0)
        laplacian = torch.diag_embed(trust.sum(-1)) - trust @ fractions.mT
        difference = (trust * ((fractions * flat).sum(-2, keepdim=True) - flat)).sum(-1, keepdim=True)
        scales = torch.linalg.pinv(laplacian, rtol=1e-9, hermitian=True) @ difference
        # Views see different things at edges, and these must not pull: where they disagree they count less.
        aligned = (flat + scales).detach().movedim(-2, 0)
        _, squared = mean_and_squares(aligned.unsqueeze(-2), trust.movedim(-2, 0).unsqueeze(-2), 1)
        agreement = cauchy_weights(squared, flat_weights.movedim(-2, 0).unsqueeze(-2), 1).squeeze(-2)
        trust = flat_weights * agreement.movedim(0, -2)
    return scales.movedim(-2, 0).to(values)[(..., *(None,) * dims)]
