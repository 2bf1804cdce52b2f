# SPDX-License-Identifier: Apache-2.0
"""Light from where rays hit nothing: two colours, and clouds before them."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["sky_light"]


def sky_light(
    background: Float[Tensor, "2 3"], clouds: Float[Tensor, "K 5"], direction: Float[Tensor, "3 ..."]
) -> Float[Tensor, "3 ..."]:
    """Return the linear colours ``(3, ...)`` of the sky in directions ``(3, ...)``.

    Args:
        background: ``(2, 3)`` colours above and below the horizon.
        clouds: ``(K, 5)`` waves over the unit sphere: wave vector, phase and amplitude. Their sum, as a logit, is the
            share of the sky's brightest value in place of its colour. None where K is 0.
        direction: unit vectors, y down.

    Examples:
        >>> blue_over_grey = torch.tensor([[0.2, 0.4, 0.9], [0.5, 0.5, 0.5]])
        >>> sky_light(blue_over_grey, torch.zeros(0, 5), torch.tensor([0.0, -1.0, 0.0]))
        tensor([0.2000, 0.4000, 0.9000])
        >>> overcast = torch.tensor([[0.0, 0.0, 0.0, 1.5708, 9.0]])
        >>> sky_light(blue_over_grey, overcast, torch.tensor([0.0, -1.0, 0.0]))
        tensor([0.8999, 0.8999, 0.9000])
    """
    up = (0.5 - 2 * direction[1]).clamp(0, 1)
    above, below = background.view(2, 3, *[1] * up.ndim)
    color = torch.lerp(below, above, up)
    if len(clouds):
        cover = torch.zeros_like(up)
        for *wave, phase, amplitude in clouds.tolist():
            angle = wave[0] * direction[0] + wave[1] * direction[1] + (wave[2] * direction[2] + phase)
            cover.add_(angle.sin_(), alpha=amplitude)
        color = torch.lerp(color, background.amax().expand_as(color), cover.sigmoid_())
    return color
