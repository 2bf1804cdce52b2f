# SPDX-License-Identifier: Apache-2.0
"""Crown convolutions, norms and pooling against loops over vertices and planar layers of torch."""

import pytest
import torch
from torch import Tensor, nn

from sphericalvision.crown import (
    Crown,
    CrownAvgPool2d,
    CrownBatchNorm2d,
    CrownBatchNorm3d,
    CrownInstanceNorm2d,
    CrownInstanceNorm3d,
    crown_conv2d,
    crown_conv3d,
    crown_upsample,
    to_crown,
)
from sphericalvision.crown.norm import NORMS, crown_norm
from sphericalvision.icosphere import Icosphere, icosphere_neighbors, num_icosphere_vertices
from tests.values import random_values

# Neighbours in the order of the taps 0 to 5, as (row, column) steps in each kind of rectangle.
COL_STEPS = ((0, -1), (1, -1), (1, 0), (0, 1), (-1, 1), (-1, 0))
ROW_STEPS = ((-1, 0), (0, -1), (1, -1), (1, 0), (0, 1), (-1, 1))


def loop_convolution(rectangles: Tensor, weight: Tensor, steps: tuple[tuple[int, int], ...]) -> Tensor:
    """Seven taps at every place of ``(B, 5, C, h, w)``; a step over the border stays on it."""
    height, width = rectangles.shape[-2:]
    result = rectangles.new_zeros(*rectangles.shape[:2], len(weight), height, width)
    for i in range(height):
        for j in range(width):
            for tap, (di, dj) in enumerate((*steps, (0, 0))):
                y, x = min(max(i + di, 0), height - 1), min(max(j + dj, 0), width - 1)
                result[..., i, j] += rectangles[..., y, x] @ weight[:, :, tap].T
    return result


def loop_convolution3d(volumes: Tensor, weight: Tensor, steps: tuple[tuple[int, int], ...]) -> Tensor:
    """The sum of three planar convolutions of shifted hypotheses."""
    count = volumes.shape[3]
    results = []
    for j in range(count):
        neighbors = [volumes[:, :, :, min(max(j + d, 0), count - 1)] for d in (-1, 0, 1)]
        results.append(
            sum(loop_convolution(neighbors[d], weight[..., 7 * d : 7 * d + 7], steps) for d in range(3))
        )
    return torch.stack(results, 3)


@pytest.mark.parametrize("level", [1, 2])
@pytest.mark.parametrize("stride", [1, 2])
def test_conv2d_agrees_with_a_loop(level: int, stride: int) -> None:
    crown = to_crown(random_values(2, 3, num_icosphere_vertices(level)))
    weight, bias = random_values(4, 3, 7), random_values(4)
    result = crown_conv2d(crown, weight, bias, stride)
    for ours, rectangles, steps in zip(result, crown, (COL_STEPS, ROW_STEPS), strict=True):
        expected = loop_convolution(rectangles, weight, steps) + bias[:, None, None]
        torch.testing.assert_close(ours, expected[..., ::stride, ::stride])


@pytest.mark.parametrize("stride", [1, 2])
def test_conv3d_agrees_with_a_loop(stride: int) -> None:
    crown = to_crown(random_values(2, 3, 4, 42))
    weight = random_values(5, 3, 21)
    result = crown_conv3d(crown, weight, stride=stride)
    for ours, volumes, steps in zip(result, crown, (COL_STEPS, ROW_STEPS), strict=True):
        expected = loop_convolution3d(volumes, weight, steps)
        torch.testing.assert_close(ours, expected[..., ::stride, ::stride])


def test_taps_are_the_neighbours_on_the_sphere_in_turn() -> None:
    """Inside the rectangles, a tap of its own reads the true neighbours of a vertex, in one sense of rotation."""
    level = 3
    ids = torch.arange(num_icosphere_vertices(level), dtype=torch.float64)
    neighbors = icosphere_neighbors(level)
    crown = to_crown(ids.view(1, 1, -1))
    taps = torch.eye(7, dtype=torch.float64)[:, None]
    for rectangles, centers in zip(crown_conv2d(crown, taps), crown, strict=True):
        interior = rectangles[0, :, :, 1:-1, 1:-1].movedim(1, -1).reshape(-1, 7).long()
        assert torch.equal(interior[:, 6], centers[0, :, 0, 1:-1, 1:-1].flatten().long())
        for center, *ring in interior[:, [6, 0, 1, 2, 3, 4, 5]].tolist():
            around = neighbors[center].tolist()
            turn = (around.index(ring[1]) - around.index(ring[0])) % 6
            start = around.index(ring[0])
            assert ring == [around[(start + turn * k) % 6] for k in range(6)]
            assert turn == 5  # clockwise from outside, counter-clockwise from inside, as panoramas are seen


@pytest.mark.parametrize(("norm", "sizes"), [(CrownBatchNorm2d, ()), (CrownBatchNorm3d, (4,))])
def test_batch_norm_is_one_norm_over_all_places(norm: type[nn.Module], sizes: tuple[int, ...]) -> None:
    """Against torch's own layer fed with all places in a row, in training and in evaluation."""
    crown = to_crown(random_values(2, 3, *sizes, 42))
    ours, theirs = norm(3, dtype=torch.float64), nn.BatchNorm1d(3, dtype=torch.float64)
    nn.init.uniform_(ours.weight)
    nn.init.uniform_(ours.bias)
    theirs.load_state_dict(ours.state_dict())

    def in_a_row(crown: Crown) -> Tensor:
        return torch.cat([x.transpose(1, 2).flatten(2) for x in crown], -1)

    for _ in range(2):
        torch.testing.assert_close(in_a_row(ours(crown)), theirs(in_a_row(crown)))
    for key, value in theirs.state_dict().items():
        torch.testing.assert_close(ours.state_dict()[key], value)
    torch.testing.assert_close(in_a_row(ours.eval()(crown)), theirs.eval()(in_a_row(crown)))


def test_norms_by_name() -> None:
    types = [CrownBatchNorm2d, CrownBatchNorm3d, CrownInstanceNorm2d, CrownInstanceNorm3d]
    norms = [crown_norm(kind, dims, 3) for kind in NORMS for dims in (2, 3)]
    assert [(type(norm), norm.num_features) for norm in norms] == [(each, 3) for each in types]


@pytest.mark.parametrize(("norm", "sizes"), [(CrownBatchNorm2d, ()), (CrownBatchNorm3d, (4,))])
def test_groups_are_normalised_one_after_another(norm: type[nn.Module], sizes: tuple[int, ...]) -> None:
    values = random_values(6, 3, *sizes, 42)
    together, apart = (norm(3, dtype=torch.float64) for _ in range(2))
    together.groups = 3  # type: ignore[assignment]
    results = zip(*(apart(to_crown(part)) for part in values.split(2)), strict=True)
    for ours, theirs in zip(together(to_crown(values)), results, strict=True):
        torch.testing.assert_close(ours, torch.cat(theirs))
    for key, value in apart.state_dict().items():
        torch.testing.assert_close(together.state_dict()[key], value)


def test_a_norm_folded_into_a_convolution_is_the_norm_after_it() -> None:
    norm, weight = CrownBatchNorm2d(3, dtype=torch.float64).eval(), random_values(3, 4, 7)
    for values in (norm.weight, norm.bias, norm.running_mean, norm.running_var):
        nn.init.uniform_(values, 0.5, 2.0)
    crown = to_crown(random_values(2, 4, 42))
    folded, expected = crown_conv2d(crown, *norm.folded(weight)), norm(crown_conv2d(crown, weight))
    for ours, theirs in zip(folded, expected, strict=True):
        torch.testing.assert_close(ours, theirs)


def test_average_pool_agrees_with_a_loop() -> None:
    crown = to_crown(random_values(1, 2, 42))
    for pooled, rectangles in zip(CrownAvgPool2d()(crown), crown, strict=True):
        for i, j in torch.cartesian_prod(*map(torch.arange, pooled.shape[-2:])).tolist():
            window = rectangles[..., max(2 * i - 1, 0) : 2 * i + 2, max(2 * j - 1, 0) : 2 * j + 2]
            torch.testing.assert_close(pooled[..., i, j], window.mean((-2, -1)))


@pytest.mark.parametrize("level", range(4))
def test_upsampling_is_the_interpolation_on_triangles(level: int) -> None:
    coarse, fine = (Icosphere(lv, torch.float64) for lv in (level, level + 1))
    for values in (random_values(2, 3, coarse.num_vertices), random_values(1, 2, 3, coarse.num_vertices)):
        crown = crown_upsample(to_crown(values))
        expected = to_crown(coarse.sample(values, fine.vertices))  # the borders of the rectangles agree, too
        torch.testing.assert_close(crown.col, expected.col)
        torch.testing.assert_close(crown.row, expected.row)
