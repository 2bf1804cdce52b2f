# SPDX-License-Identifier: Apache-2.0
"""Edges, thin things and flat surfaces of known scenes; intervals and sparsification against brute force."""

import math

import pytest
import torch

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


def test_a_plane_as_steep_as_a_step_is_an_edge_and_not_flat() -> None:
    steep, slow = (depth_structure(slope * ICO.vertices[:, 0]) for slope in (45.0, 4.5))
    assert steep.edge.float().mean() > 0.8
    assert not (steep.edge & steep.flat).any()
    assert slow.flat.all()


def test_contrast_of_a_step() -> None:
    image = (ICO.vertices[:, 0] > 0).float().expand(3, -1)
    contrast = local_contrast(image)
    far = ICO.vertices[:, 0].abs() > 0.06
    assert contrast[far].max() < 1e-6
    second = (ICO.vertices[:, 0].abs() - 0.025).abs() < 0.002  # farther away than an edge is long
    assert contrast[second].min() > 0.1
    assert contrast.max() == pytest.approx(0.5, abs=0.02)


def test_bootstrap_intervals_of_many_values_are_those_of_a_normal_mean() -> None:
    values = torch.rand(200, generator=torch.Generator().manual_seed(1)).double()
    interval = bootstrap_interval(values)
    half = 1.960 * values.std().item() / math.sqrt(200)
    assert interval.mean == pytest.approx(values.mean().item())
    assert interval.low == pytest.approx(interval.mean - half, abs=0.05 * half)
    assert interval.high == pytest.approx(interval.mean + half, abs=0.05 * half)


def test_bootstrap_leaves_out_what_is_unknown() -> None:
    assert math.isnan(bootstrap_interval([math.nan]).mean)
    assert bootstrap_interval([2.0, math.nan, 4.0]).mean == 3.0
    few = bootstrap_interval([0.3, 1.7, 0.9, math.nan, 5.2, 2.1, 3.3, 0.05])
    assert few == pytest.approx((1.9357143, 0.8280357, 3.2573214))


def test_the_surest_by_brute_force() -> None:
    generator = torch.Generator().manual_seed(2)
    error, sure = torch.rand(2, 50, generator=generator), torch.rand(2, 50, generator=generator)
    mask = torch.rand(2, 50, generator=generator) < 0.8
    shares = (0.3, 0.48, 0.001, 0.75, 1.0)
    found = error_of_surest(error, sure, shares, mask)
    for row in range(2):
        known = [(s, e) for s, e, m in zip(*(x[row].tolist() for x in (sure, error, mask)), strict=True) if m]
        ranked = [e for _, e in sorted(known, reverse=True)]
        for column, share in enumerate(shares):
            kept = ranked[: max(1, round(share * len(ranked)))]
            assert found[row, column].item() == pytest.approx(sum(kept) / len(kept), rel=1e-5)
