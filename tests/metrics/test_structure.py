# SPDX-License-Identifier: Apache-2.0
"""Edges, thin things and flat surfaces of known scenes; intervals and sparsification against brute force."""

from __future__ import annotations

import math

import pytest
import torch

from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import Icosphere, icosphere_neighbors
from sphericalvision.metrics.spread import bootstrap_interval, error_of_surest
from sphericalvision.metrics.structure import depth_structure, local_contrast

ICO = Icosphere(6)


def test_a_room_is_flat_but_for_its_edges_in_no_place() -> None:
    """Inside of a box depth has creases and no steps: flat away from the creases, no edges, nothing thin."""
    half = torch.tensor([2.0, 1.2, 3.0])
    inverse = (ICO.vertices.abs() / half).amax(-1)
    structure = depth_structure(15 * 0.55 * inverse[None])
    second = (ICO.vertices.abs() / half).sort(-1, descending=True).values
    crease = (second[:, 0] - second[:, 1]) * 15 * 0.55 < 0.4
    assert not structure.edge.any()
    assert not structure.thin.any()
    assert structure.flat[0][~crease].all()
    assert not structure.flat.all()


def test_a_ball_before_a_far_shell() -> None:
    """The rim is an edge on both sides; a small ball is thin, a large one is not, but at its rim."""
    to_ball = torch.acos(ICO.vertices @ torch.nn.functional.normalize(torch.tensor([0.3, -0.2, 0.9]), dim=0))
    for radius_deg, thin in ((1.2, True), (12.0, False)):
        radius = math.radians(radius_deg)
        index = torch.where(to_ball < radius, 8.0, 1.0)[None]
        structure = depth_structure(index)
        neighbors = icosphere_neighbors(6)
        touched = index[0][neighbors.clamp(min=0)]
        expected = (touched.amax(-1) != touched.amin(-1)) | (index[0] != touched[:, 0])
        assert torch.equal(structure.edge[0], expected)
        inside = to_ball < radius
        assert bool(structure.thin[0][inside].all()) == thin
        assert not structure.thin[0][~inside].any()


def test_contrast_of_a_step() -> None:
    image = (ICO.vertices[:, 0] > 0).float().expand(3, -1)
    contrast = local_contrast(image)
    far = ICO.vertices[:, 0].abs() > 0.06
    assert contrast[far].max() < 1e-6
    assert contrast.max() == pytest.approx(0.5, abs=0.02)


def test_bootstrap_covers_as_often_as_it_says() -> None:
    """Of normal samples the interval of 90 % holds the true mean about nine times of ten (a little less: 20 values)."""
    generator = torch.Generator().manual_seed(1)
    hits = 0
    for trial in range(200):
        values = torch.randn(20, generator=generator) + 3
        interval = bootstrap_interval(values, 0.9, draws=400, seed=trial)
        hits += interval.low <= 3 <= interval.high
    assert 160 <= hits <= 192
    assert math.isnan(bootstrap_interval([math.nan]).mean)
    assert bootstrap_interval([2.0, math.nan, 4.0]).mean == 3.0
    with pytest.raises(ArgumentError, match="probability"):
        bootstrap_interval([1.0], 1.5)


def test_the_surest_by_brute_force() -> None:
    generator = torch.Generator().manual_seed(2)
    error, sure = torch.rand(2, 50, generator=generator), torch.rand(2, 50, generator=generator)
    mask = torch.rand(2, 50, generator=generator) < 0.8
    found = error_of_surest(error, sure, (0.3, 1.0), mask)
    for row in range(2):
        known = [(s, e) for s, e, m in zip(*(x[row].tolist() for x in (sure, error, mask)), strict=True) if m]
        ranked = [e for _, e in sorted(known, reverse=True)]
        kept = ranked[: round(0.3 * len(ranked))]
        assert found[row, 0].item() == pytest.approx(sum(kept) / len(kept), rel=1e-5)
        assert found[row, 1].item() == pytest.approx(sum(ranked) / len(ranked), rel=1e-5)
    with pytest.raises(ArgumentError, match="shares"):
        error_of_surest(error, sure, (0.0,))
