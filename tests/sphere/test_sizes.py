# SPDX-License-Identifier: Apache-2.0
"""A digit too many is an error before memory is taken."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from sphericalvision.core import ArgumentError
from sphericalvision.sphere import Cubemap, Equirectangular, Healpix, TangentImages


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: Equirectangular(10**7, 2 * 10**7), "height, width"),
        (lambda: Equirectangular.with_square_pixels(10**6, 10**7), "height, width"),
        (lambda: Cubemap(10**6), "size"),
        (lambda: Healpix(2**20), "nside"),
        (lambda: TangentImages(3, 10**6), "base_level, size"),
        (lambda: TangentImages(40, 8), "level"),
    ],
)
def test_sizes_have_bounds(make: Callable[[], object], named: str) -> None:
    with pytest.raises(ArgumentError, match=rf"^{named}: expected"):
        make()
