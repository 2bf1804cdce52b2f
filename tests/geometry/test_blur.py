# SPDX-License-Identifier: Apache-2.0
"""The blur, against kornia's."""

from __future__ import annotations

from typing import Literal

import pytest
import torch
from kornia.filters import gaussian_blur2d

from sphericalvision.geometry.blur import gaussian_blur


@pytest.mark.parametrize("border", ["reflect", "constant"])
def test_blur_against_kornia(border: Literal["reflect", "constant"], generator: torch.Generator) -> None:
    images = torch.rand(2, 3, 20, 30, generator=generator)
    torch.testing.assert_close(
        gaussian_blur(images, 1.5, border), gaussian_blur2d(images, 11, (1.5, 1.5), border)
    )
    torch.testing.assert_close(gaussian_blur(images[0], 1.5, border), gaussian_blur(images, 1.5, border)[0])
