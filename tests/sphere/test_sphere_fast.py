# SPDX-License-Identifier: Apache-2.0
"""The fast convolution of the sphere, and lookups, give the numbers of the reference."""

import pytest
import torch

from sphericalvision.icosphere import Icosphere
from sphericalvision.sphere import Equirectangular, Healpix, Resample, SphereConv2d
from sphericalvision.sphere.fast import row_sums
from tests.laws.fast_laws import (
    FastCase,
    law_gradients_agree,
    law_gradients_of_gradients_agree,
    law_modes_agree,
    law_values_agree,
)

CONVOLUTIONS = [
    FastCase("convolution", lambda: SphereConv2d(2, 3), (2, 6, 12)),
    FastCase("odd size", lambda: SphereConv2d(2, 4, groups=2), (2, 7, 13)),
    FastCase("stride", lambda: SphereConv2d(2, 4, stride=2, groups=2), (2, 40, 90)),
    FastCase("stride that does not divide the width", lambda: SphereConv2d(2, 3, stride=(2, 3)), (2, 8, 16)),
    FastCase("wide kernel", lambda: SphereConv2d(1, 2, (3, 5), dilation=2, bias=False), (1, 12, 36)),
]
LOOKUPS = [
    FastCase("triangles", lambda: Resample(Icosphere(2), Equirectangular(12, 24)), (2, 162)),
    FastCase("HEALPix", lambda: Resample(Healpix(4), Icosphere(2), mode="area"), (2, 192)),
    FastCase("panorama", lambda: Resample(Equirectangular(6, 12), Icosphere(2)), (2, 6, 12)),
]


by_each_way = pytest.mark.parametrize("way", ["auto", "graph"])


@pytest.fixture(autouse=True)
def a_few_rows_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(row_sums, "CACHE_BYTES", 10_000)


@by_each_way
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("case", CONVOLUTIONS + LOOKUPS, ids=lambda case: case.name)
def test_values(case: FastCase, batch: int, dtype: torch.dtype, way: str) -> None:
    law_values_agree(case, batch, dtype, training=True, way=way)


@by_each_way
@pytest.mark.parametrize("case", CONVOLUTIONS + LOOKUPS, ids=lambda case: case.name)
def test_gradients(case: FastCase, way: str) -> None:
    law_gradients_agree(case, 2, training=True, way=way)


@pytest.mark.parametrize("case", [*CONVOLUTIONS[:3], *LOOKUPS[:2]], ids=lambda case: case.name)
def test_gradients_of_gradients(case: FastCase) -> None:
    law_gradients_of_gradients_agree(case, 1, training=True)


@pytest.mark.parametrize("case", CONVOLUTIONS + LOOKUPS, ids=lambda case: case.name)
def test_modes(case: FastCase) -> None:
    law_modes_agree(case, 2)
