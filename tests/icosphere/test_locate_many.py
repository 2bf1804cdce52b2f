# SPDX-License-Identifier: Apache-2.0
"""Location of many directions by table gives the triangles that the way down gives."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from sphericalvision.icosphere import Icosphere, locate
from sphericalvision.icosphere.descent import barycentric_weights, descend
from sphericalvision.icosphere.fast.locate_many import locate_many


def on_edges_and_corners(level: int, dtype: torch.dtype) -> Tensor:
    """Vertices, and middles of edges and faces of this icosphere and of the icosahedron."""
    directions = []
    for ico in (Icosphere(level, dtype), Icosphere(0, dtype)):
        corners = ico.vertices[ico.faces]
        directions += [ico.vertices, corners[:, :2].mean(1), corners.mean(1)]
    return torch.cat(directions)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("level", [0, 1, 4, 7])
def test_the_same_triangles_and_weights(
    level: int, dtype: torch.dtype, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sphericalvision.icosphere.fast.locate_many.chunk_size", lambda device: 8192)
    directions = torch.randn(2 * 8192 + 77, 3, generator=generator, dtype=torch.float64).to(dtype)
    unit = torch.nn.functional.normalize(directions, dim=-1)
    ids, weights = locate_many(directions, level)
    triangles = descend(unit, level)
    same = (ids == triangles.vertex_ids(level)).all(-1)
    eps = torch.finfo(dtype).eps * 2**level
    assert (~same).double().mean() <= (0 if dtype == torch.float64 else 100 * eps)
    expected = barycentric_weights(unit, triangles.corners)
    torch.testing.assert_close(weights[same], expected[same], rtol=0, atol=8 * eps)
    assert weights.min() > -16 * eps


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("level", [0, 1, 3, 5])
def test_edges_and_corners(level: int, dtype: torch.dtype) -> None:
    """One of the triangles that share them: the weights rebuild the direction."""
    ico = Icosphere(level, dtype)
    directions = on_edges_and_corners(level, dtype)
    ids, weights = locate_many(directions, level)
    faces = {tuple(sorted(face)) for face in ico.faces.tolist()}
    assert all(tuple(sorted(triple)) in faces for triple in ids.tolist())
    eps = torch.finfo(dtype).eps
    assert weights.min() > -16 * 2**level * eps
    rebuilt = torch.nn.functional.normalize((ico.vertices[ids] * weights[..., None]).sum(1), dim=-1)
    unit = torch.nn.functional.normalize(directions, dim=-1)
    torch.testing.assert_close(rebuilt, unit, rtol=0, atol=8 * eps)


def test_no_direction_has_valid_ids_and_no_weights() -> None:
    directions = torch.tensor([[0.0, 0.0, 0.0], [torch.nan, 0.0, 1.0], [torch.inf, 0.0, 1.0]]).repeat(100, 1)
    ids, weights = locate(directions, 1)
    assert ((ids >= 0) & (ids < 42)).all()
    assert weights.isnan().any(-1).all()


def test_gradients_are_those_of_few_directions(generator: torch.Generator) -> None:
    directions = torch.randn(100, 3, generator=generator, dtype=torch.float64)
    gradients = []
    for count in (100, 1):  # at once by table, one by one by the way down
        given = directions.clone().requires_grad_()
        weights = torch.cat([locate(part, 1)[1] for part in given.split(count)])
        (weights * torch.arange(3.0)).square().sum().backward()
        gradients.append(given.grad)
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_located_in_float32(dtype: torch.dtype, generator: torch.Generator) -> None:
    directions = torch.randn(500, 3, generator=generator).to(dtype)
    ids, weights = locate_many(directions, 2)
    expected_ids, expected = locate_many(directions.float(), 2)
    assert torch.equal(ids, expected_ids)
    assert torch.equal(weights, expected.to(dtype))
