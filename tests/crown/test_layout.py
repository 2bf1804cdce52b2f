# SPDX-License-Identifier: Apache-2.0
"""Laws of the crown layout: its geometry, and how unfolding and folding undo and mirror each other."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sphericalvision.crown import Crown, crown_relu, from_crown, to_crown
from sphericalvision.icosphere import icosphere_vertices, num_icosphere_vertices
from sphericalvision.icosphere.topology import chart_vertex_ids


def random_crown(level: int, *channels: int, dtype: torch.dtype = torch.float64) -> Crown:
    n = 2**level
    generator = torch.Generator().manual_seed(level)
    col, row = (
        torch.randn(2, 5, *channels, *size, dtype=dtype, generator=generator)
        for size in ((2 * n + 1, n + 1), (n + 1, 2 * n + 1))
    )
    return Crown(col, row)


def vertex_ids(level: int) -> Crown:
    """The vertex at every place."""
    ids = torch.arange(num_icosphere_vertices(level), dtype=torch.float64)
    return Crown(*(rectangles[0, :, 0].long() for rectangles in to_crown(ids.view(1, 1, -1))))


@settings(max_examples=25, deadline=None)
@given(
    level=st.integers(0, 4),
    batch=st.integers(1, 3),
    channels=st.integers(1, 4),
    hypotheses=st.one_of(st.none(), st.integers(1, 4)),
    seed=st.integers(0, 1000),
)
def test_round_trip(level: int, batch: int, channels: int, hypotheses: int | None, seed: int) -> None:
    shape = (batch, channels, *([] if hypotheses is None else [hypotheses]), num_icosphere_vertices(level))
    values = torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    crown = to_crown(values)
    n = 2**level
    assert crown.col.shape == (batch, 5, *shape[1:-1], 2 * n + 1, n + 1)
    assert crown.row.shape == (batch, 5, *shape[1:-1], n + 1, 2 * n + 1)
    assert crown.level == level
    torch.testing.assert_close(from_crown(crown), values, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("level", [0, 1, 3])
def test_col_rectangles_are_the_charts(level: int) -> None:
    assert torch.equal(vertex_ids(level).col, chart_vertex_ids(level))


def test_row_rectangles_literals() -> None:
    """Level 0: the north-west corner is the north pole, the south-east corner the south pole."""
    assert vertex_ids(0).row.tolist() == [
        [[0, 3, 6], [1, 4, 11]],
        [[0, 5, 8], [3, 6, 11]],
        [[0, 7, 10], [5, 8, 11]],
        [[0, 9, 2], [7, 10, 11]],
        [[0, 1, 4], [9, 2, 11]],
    ]


@pytest.mark.parametrize("level", [1, 2, 4])
def test_neighbouring_places_are_neighbours_on_the_sphere(level: int) -> None:
    vertices = icosphere_vertices(level, torch.float64)
    for ids in vertex_ids(level):
        places, longest = vertices[ids], 1.4 / 2**level
        assert (places[:, 1:] - places[:, :-1]).norm(dim=-1).max() < longest
        assert (places[:, :, 1:] - places[:, :, :-1]).norm(dim=-1).max() < longest
        assert (places[:, 1:, :-1] - places[:, :-1, 1:]).norm(dim=-1).max() < longest


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("channels", [(3,), (3, 4)])
def test_from_crown_is_the_mean_over_places(level: int, channels: tuple[int, ...]) -> None:
    """Against a loop over all places."""
    crown, ids = random_crown(level, *channels), vertex_ids(level)
    places: list[list[torch.Tensor]] = [[] for _ in range(num_icosphere_vertices(level))]
    for rectangles, rectangle_ids in zip(crown, ids, strict=True):
        for k, i, j in torch.cartesian_prod(*map(torch.arange, rectangle_ids.shape)).tolist():
            places[rectangle_ids[k, i, j]].append(rectangles[:, k, ..., i, j])
    expected = torch.stack([torch.stack(values).mean(0) for values in places], -1)
    torch.testing.assert_close(from_crown(crown), expected)
    assert len(places[0]) == len(places[-1]) == 10
    assert min(map(len, places)) >= 2


def test_addition_and_relu() -> None:
    crown = random_crown(1, 2)
    assert torch.equal((crown + crown).row, 2 * crown.row)
    assert torch.equal(crown_relu(crown).col, crown.col.clamp(min=0))
