# SPDX-License-Identifier: Apache-2.0
"""Local appearance: a descriptor of image vertices that does not depend on exposure or viewing direction."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.icosphere import Icosphere, level_from_num_vertices
from sphericalvision.kernels import full_precision
from sphericalvision.shapes import check_shapes


@check_shapes
@full_precision
def local_appearance(
    images: Float[Tensor, "*batch 3 V"], seen: Bool[Tensor, "*batch V"] | None = None
) -> Float[Tensor, "*batch 7 V"]:
    """Return a descriptor ``(*, 7, V)`` of the neighbourhood of each vertex of images ``(*, 3, V)``.

    Its channels are the brightness less the mean of the ring, the brightness gradient as a vector in space, both
    divided by the contrast of the ring, which cancels exposure, and the three colours at half weight. A vector in space
    needs no tangent frame: cameras compare whatever their orientation.

    Args:
        images: on an icosphere.
        seen: ``(*, V)``; neighbours that are not seen do not count.

    Examples:
        >>> local_appearance(torch.zeros(2, 3, 162)).shape
        torch.Size([2, 7, 162])
    """
    grid = Icosphere(level_from_num_vertices(images.shape[-1]), images.dtype, images.device)
    ids = grid.neighbors.clamp(min=0)
    valid = grid.neighbors >= 0
    if seen is not None:
        valid = valid & seen[..., ids]
    present = valid.to(images.dtype)
    count = present.sum(-1)
    brightness = images.mean(-2)
    around = (brightness[..., ids] - brightness[..., None]) * present
    mean = around.sum(-1) / (count + 1)
    contrast = ((around - mean[..., None]).square() * present).sum(-1) / count.clamp(min=1)
    scale = (contrast.sqrt() + 0.05).reciprocal()
    edges = torch.nn.functional.normalize(grid.vertices[ids] - grid.vertices[:, None], dim=-1)
    gradient = torch.einsum("...vk,vkd->...dv", around, edges) * (2 / count.clamp(min=1))[..., None, :]
    relative = torch.cat((-mean[..., None, :], gradient), -2) * scale[..., None, :]
    return torch.cat((relative, 0.5 * images), -2)
