# SPDX-License-Identifier: Apache-2.0
"""Point location against brute force over all faces, and its derivatives."""

from contextlib import nullcontext

import pytest
import torch
from torch import Tensor

from sphericalvision.icosphere import Icosphere, TriangleLocator, locate
from sphericalvision.kernels import kernels, reference_kernels

DTYPES = [torch.float32, torch.float64]


def random_directions(count: int, dtype: torch.dtype = torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randn(count, 3, dtype=torch.float64, generator=generator).to(dtype)


def brute_force(ico: Icosphere, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Solve [a b c] w = d for every face; the face whose smallest weight is largest contains d."""
    corners = ico.vertices.double()[ico.faces].transpose(1, 2)
    weights = torch.einsum("fij,dj->dfi", torch.linalg.inv(corners), directions.double())
    face = weights.amin(-1).argmax(-1)
    weights = weights[torch.arange(len(directions)), face]
    return ico.faces[face], weights / weights.sum(-1, keepdim=True)


def special_directions(ico: Icosphere) -> Tensor:
    """Vertices, middles of edges and of faces, and the axes."""
    corners = ico.vertices[ico.faces]
    axes = torch.cat((torch.eye(3), -torch.eye(3))).to(corners)
    return torch.cat((ico.vertices, corners[:, :2].mean(1), corners.mean(1), axes))


def as_dense(ids: Tensor, weights: Tensor, count: int) -> Tensor:
    """Weights on all vertices; equal for triangles that share the edge a direction is on."""
    return torch.zeros(len(ids), count, dtype=torch.float64).scatter_add(1, ids, weights.double())


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("level", [0, 1, 2, 4])
def test_agrees_with_brute_force(level: int, dtype: torch.dtype) -> None:
    ico = Icosphere(level, dtype=torch.float64)
    directions = random_directions(200, dtype)
    ids, weights = ico.locate(directions)
    expected_ids, expected_weights = brute_force(ico, directions)
    assert weights.dtype == dtype
    tolerance = 1e-12 if dtype == torch.float64 else 1e-6 * 2**level
    torch.testing.assert_close(
        as_dense(ids, weights, ico.num_vertices),
        as_dense(expected_ids, expected_weights, ico.num_vertices),
        rtol=0,
        atol=tolerance,
    )
    if dtype == torch.float64:
        assert torch.equal(ids.sort().values, expected_ids.sort().values)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("level", [0, 1, 3])
def test_vertices_edges_and_poles(level: int, dtype: torch.dtype) -> None:
    """They are so many that tables locate them."""
    ico = Icosphere(level, dtype=dtype)
    directions = special_directions(ico)
    assert len(directions) > 2 * ico.num_vertices
    ids, weights = ico.locate(directions)
    eps = 100 * 2**level * torch.finfo(dtype).eps
    expected = as_dense(*brute_force(ico, directions), ico.num_vertices)
    torch.testing.assert_close(as_dense(ids, weights, ico.num_vertices), expected, rtol=0, atol=eps)
    own = weights[: ico.num_vertices].max(-1)
    assert torch.equal(
        ids[: ico.num_vertices].gather(1, own.indices[:, None])[:, 0], torch.arange(ico.num_vertices)
    )


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("level", [3, 6, 8])
def test_ray_meets_the_plane_of_a_true_face(level: int, dtype: torch.dtype) -> None:
    ico = Icosphere(level, dtype=dtype)
    directions = torch.nn.functional.normalize(random_directions(5000, dtype), dim=-1)
    ids, weights = ico.locate(3 * directions)
    eps = torch.finfo(dtype).eps
    torch.testing.assert_close(weights.sum(-1), torch.ones(5000, dtype=dtype))
    on_plane = (ico.vertices[ids] * weights[..., None]).sum(1)
    torch.testing.assert_close(
        torch.nn.functional.normalize(on_plane, dim=-1), directions, rtol=0, atol=8 * eps
    )
    known = {tuple(sorted(face)) for face in ico.faces.tolist()} if level < 8 else None
    if known is not None:
        assert all(tuple(sorted(triple)) in known for triple in ids.tolist())


@pytest.mark.parametrize("count", [20_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("level", range(9))
def test_weights_are_convex(level: int, count: int) -> None:
    """Not negative, and one in sum: by the way down, by tables, and in few steps; on edges and vertices too."""
    ico = Icosphere(min(level, 5), dtype=torch.float64)
    directions = torch.cat((random_directions(count), special_directions(ico))).float()
    ways = [reference_kernels(), nullcontext(), kernels("graph")]
    few = directions[torch.randperm(len(directions), generator=torch.Generator().manual_seed(1))[:20_000]]
    for way, some in zip(ways, (few, directions, few), strict=True):
        with way:
            triangles, columns = TriangleLocator(level).find(some.T.contiguous())
            slopes = TriangleLocator(level).weights(some.T, triangles)
            for weights in (locate(some, level)[1].T, columns, slopes):
                assert weights.min() >= 0
                assert (weights.sum(0) - 1).abs().max() < 1e-6


def test_gradients() -> None:
    directions = random_directions(20).requires_grad_()
    ico = Icosphere(2, dtype=torch.float64)
    assert torch.autograd.gradgradcheck(lambda d: ico.locate(d)[1], (directions,))
    at_vertices = ico.vertices.clone().requires_grad_()
    ico.locate(at_vertices)[1].square().sum().backward()
    assert at_vertices.grad.isfinite().all()


@pytest.mark.parametrize("level", [0, 2, 5])
def test_nearest_agrees_with_brute_force(level: int) -> None:
    ico = Icosphere(level, dtype=torch.float64)
    directions = random_directions(500)
    assert torch.equal(ico.nearest(directions), (directions @ ico.vertices.T).argmax(-1))
    assert torch.equal(ico.nearest(ico.vertices), torch.arange(ico.num_vertices))


def test_sample_is_exact_at_vertices_and_linear_on_faces() -> None:
    ico = Icosphere(3, dtype=torch.float64)
    values = torch.randn(2, 3, ico.num_vertices, dtype=torch.float64)
    torch.testing.assert_close(ico.sample(values, ico.vertices), values)
    middles = ico.vertices[ico.faces].mean(1)
    torch.testing.assert_close(ico.sample(values, middles), values[..., ico.faces].mean(-1))


def test_sample_batches() -> None:
    ico = Icosphere(2, dtype=torch.float64)
    values = torch.randn(2, 3, ico.num_vertices, dtype=torch.float64)
    directions = random_directions(10).view(2, 5, 3)
    expected = torch.stack([ico.sample(values[b], directions[b]) for b in range(2)])
    torch.testing.assert_close(ico.sample(values, directions), expected)
    torch.testing.assert_close(ico.sample(values[0, 0], directions[0]), expected[0, 0])
