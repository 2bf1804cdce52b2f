# SPDX-License-Identifier: Apache-2.0
"""Means by id are what adding up and dividing by the count gives."""

import torch

from sphericalvision.geometry.means_by_id import mean_by_id, means_by_id


def test_mean_is_the_sum_over_the_count() -> None:
    generator = torch.Generator().manual_seed(0)
    ids = torch.cat((torch.arange(40), torch.randint(40, (300,), generator=generator)))
    values = torch.randn(2, 3, len(ids), generator=generator, dtype=torch.float64)
    tables = means_by_id(ids, 40)
    assert len(tables.others) > 0  # ids with more places than most
    expected = values.new_zeros(2, 3, 40).index_add(-1, ids, values) / ids.bincount()
    torch.testing.assert_close(mean_by_id(values, tables), expected)
    even = means_by_id(torch.arange(40).repeat(3), 40)
    assert len(even.others) == 0
    torch.testing.assert_close(
        mean_by_id(values[..., :120], even), values[..., :120].unflatten(-1, (3, 40)).mean(-2)
    )
