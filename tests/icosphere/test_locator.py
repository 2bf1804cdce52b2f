# SPDX-License-Identifier: Apache-2.0
"""Location of many directions by tables gives the triangles and weights that the descent gives."""

import pytest
import torch
from torch import Tensor

from sphericalvision.icosphere import (
    Icosphere,
    TriangleLocator,
    icosphere_faces,
    locate,
    num_icosphere_vertices,
)
from sphericalvision.icosphere.fast.triangle_table import triangle_table
from sphericalvision.icosphere.locator import corners_by_coarser_tables, triangle_corners
from sphericalvision.kernels import kernels, reference_kernels


def located(directions: Tensor, level: int) -> tuple[Tensor, Tensor]:
    """Ids and weights ``(m, 3)`` by the tables, however few the directions are."""
    locator = TriangleLocator(level, directions.dtype)
    triangles, weights = locator.find(directions.T.contiguous())
    return locator.faces[triangles], weights.T


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("level", [0, 1, 4, 7])
def test_the_same_triangles_and_weights(level: int, dtype: torch.dtype, generator: torch.Generator) -> None:
    """Of rays of any length; next to an edge rounding decides."""
    directions = torch.randn(8_000, 3, generator=generator, dtype=torch.float64).to(dtype)
    ids, weights = located(directions, level)
    with reference_kernels():
        expected_ids, expected = locate(directions, level)
    same = (ids == expected_ids).all(-1)
    eps = torch.finfo(dtype).eps * 2**level
    assert (~same).double().mean() <= (0 if dtype == torch.float64 else 100 * eps)
    torch.testing.assert_close(weights[same], expected[same], rtol=0, atol=8 * eps)
    assert weights.min() > -16 * eps


@pytest.mark.parametrize("level", [0, 3])
def test_the_reference_locates_rays_as_columns_too(level: int, generator: torch.Generator) -> None:
    """Numbers of triangles, weights and their gradients, with tables and without."""
    given = 3 * torch.randn(3, 500, generator=generator, dtype=torch.float64)
    answers = []
    for reference in (False, True):
        rays = given.clone().requires_grad_()
        if reference:
            with reference_kernels():
                locator = TriangleLocator(level, torch.float64)
        else:
            locator = TriangleLocator(level, torch.float64)
        assert torch.equal(locator.faces, icosphere_faces(level))
        triangles, found = locator.find(rays)
        weights = locator.weights(rays, triangles)
        torch.testing.assert_close(weights.detach(), found)
        (gradient,) = torch.autograd.grad((weights * torch.arange(3.0)[:, None]).square().sum(), rays)
        answers.append((triangles.long(), weights, gradient))
    torch.testing.assert_close(*answers)


def test_chunks_change_nothing(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    directions = torch.randn(1077, 3, generator=generator)
    expected = locate(directions, 2)
    monkeypatch.setattr("sphericalvision.icosphere.locator.chunk_size", lambda device: 500)
    torch.testing.assert_close(locate(directions, 2), expected, rtol=0, atol=0)


def test_reference_kernels_make_no_tables(
    monkeypatch: pytest.MonkeyPatch, generator: torch.Generator
) -> None:
    """Nothing of the fast wing runs inside the block, however many directions there are."""

    def refuse(*_: object) -> None:
        raise AssertionError("a table was asked for")

    monkeypatch.setattr("sphericalvision.icosphere.locator.triangle_table", refuse)
    directions = torch.randn(100, 3, generator=generator)
    with pytest.raises(AssertionError, match="a table"):
        locate(directions, 0)
    with reference_kernels():
        locate(directions, 0)
        TriangleLocator(0).find(directions.T)


def test_no_direction_has_valid_ids_and_no_weights() -> None:
    directions = torch.tensor([[0.0, 0.0, 0.0], [torch.nan, 0.0, 1.0], [torch.inf, 0.0, 1.0]]).repeat(100, 1)
    for some in (directions, directions[:3]):
        ids, weights = locate(some, 1)
        assert ((ids >= 0) & (ids < 42)).all()
        assert weights.isnan().any(-1).all()


class Located(torch.nn.Module):
    """Weights of given directions, and values sampled at others that are part of the program."""

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__()
        self.ico = Icosphere(1)
        self.fixed = torch.randn(200, 3, generator=generator)

    def forward(self, directions: Tensor, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return *locate(directions, 1), self.ico.sample(values, self.fixed)


def test_programs_with_many_directions_can_be_exported(generator: torch.Generator) -> None:
    """Their values are unknown in the program, and no table made there is kept for later calls."""
    module = Located(generator)
    inputs = torch.randn(300, 3, generator=generator), torch.randn(2, 42, generator=generator)
    program = torch.export.export(module, inputs)
    torch.testing.assert_close(program.module()(*inputs), module(*inputs))
    assert triangle_table(1, torch.float32, torch.device("cpu")).cells.sum() > 0


@pytest.mark.parametrize("level", [0, 1, 5])
def test_tables_of_the_coarser_level_interpolate_as_the_own_ones(
    level: int, generator: torch.Generator
) -> None:
    vertices = Icosphere(min(level + 1, 5)).vertices  # corners, middles of edges
    rays = torch.cat((torch.randn(2_000, 3, generator=generator), vertices)).T.contiguous()
    values = torch.randn(num_icosphere_vertices(level), generator=generator)
    with reference_kernels():
        expected = interpolated(values, *triangle_corners(rays, level))
        torch.testing.assert_close(interpolated(values, *corners_by_coarser_tables(rays, level)), expected)
    for mode in ("plain", "graph"):
        with kernels(mode):
            ids, weights = corners_by_coarser_tables(rays, level)
        assert weights.min() >= 0
        torch.testing.assert_close(weights.sum(1), torch.ones(len(weights)))
        torch.testing.assert_close(interpolated(values, ids, weights), expected, rtol=0, atol=2e-6 * 2**level)


def interpolated(values: Tensor, ids: Tensor, weights: Tensor) -> Tensor:
    return (values[ids] * weights).sum(1)
