# SPDX-License-Identifier: Apache-2.0
"""Networks made of layers in a row on crowns, and maximum pooling."""

import pytest
import torch
from torch import nn

from sphericalvision.crown import (
    CrownAvgPool2d,
    CrownBatchNorm2d,
    CrownConv2d,
    CrownExchange,
    CrownMaxPool2d,
    CrownPointwise,
    CrownUpsample,
    FromCrown,
    ToCrown,
    crown_avg_pool2d,
    crown_conv2d,
    crown_max_pool2d,
    crown_relu,
    crown_upsample,
    exchange,
    from_crown,
    to_crown,
)
from sphericalvision.icosphere import icosphere_neighbors
from sphericalvision.icosphere.topology import coarse_vertex_ids
from tests.values import random_values


def test_layers_in_a_row_are_the_functions_one_after_the_other() -> None:
    network = nn.Sequential(
        ToCrown(),
        CrownConv2d(3, 4),
        CrownBatchNorm2d(4),
        CrownPointwise(nn.ReLU()),
        CrownExchange(),
        CrownAvgPool2d(),
        CrownMaxPool2d(),
        CrownUpsample(),
        FromCrown(),
    ).double()
    network.eval()
    values = random_values(2, 3, 162)
    crown = crown_relu(network[2](crown_conv2d(to_crown(values), network[1].weight)))
    crown = crown_upsample(crown_max_pool2d(crown_avg_pool2d(exchange(crown))))
    torch.testing.assert_close(network(values), from_crown(crown))
    assert network(values).shape == (2, 4, 42)


@pytest.mark.parametrize(
    "module", [nn.GELU(), nn.PReLU(3), nn.Conv2d(3, 5, 1), nn.Identity(), nn.Conv3d(3, 2, 1)]
)
def test_pointwise_modules_act_on_every_place_as_on_vertices(module: nn.Module) -> None:
    values = random_values(2, 3, *([4] if isinstance(module, nn.Conv3d) else []), 42)
    module = module.double()
    expected = module(values[..., None])[..., 0]
    torch.testing.assert_close(FromCrown()(CrownPointwise(module)(to_crown(values))), expected)
    assert list(CrownPointwise(nn.PReLU(3)).state_dict()) == ["module.weight"]


@pytest.mark.parametrize("stride", [1, 2])
def test_max_pool_agrees_with_a_loop(stride: int) -> None:
    crown = to_crown(random_values(1, 2, 162))
    for pooled, rectangles in zip(CrownMaxPool2d(stride)(crown), crown, strict=True):
        height, width = rectangles.shape[-2:]
        for i, j in torch.cartesian_prod(*map(torch.arange, pooled.shape[-2:])).tolist():
            steps = ((0, 0), (0, -1), (1, -1), (1, 0), (0, 1), (-1, 1), (-1, 0))
            places = [(stride * i + di, stride * j + dj) for di, dj in steps]
            inside = [rectangles[..., y, x] for y, x in places if 0 <= y < height and 0 <= x < width]
            torch.testing.assert_close(pooled[..., i, j], torch.stack(inside).amax(0))


def test_max_pool_of_smooth_maxima_is_that_of_the_true_neighbors() -> None:
    """The larger of the two kinds of rectangles sees every neighbour of a vertex inside one of them."""
    values = random_values(1, 1, 162)
    crown = CrownMaxPool2d()(to_crown(values))
    neighbors = icosphere_neighbors(2)
    around = torch.cat((torch.arange(162)[:, None], neighbors), 1)
    true = torch.where(around < 0, -torch.inf, values[0, 0][around]).amax(1)[coarse_vertex_ids(2)]
    for rectangles, ids in zip(crown, to_crown(torch.arange(42.0)[None, None]), strict=True):
        inner, inner_ids = rectangles[0, :, 0, 1:-1, 1:-1], ids[0, :, 0, 1:-1, 1:-1].long()
        torch.testing.assert_close(inner, true[inner_ids])
