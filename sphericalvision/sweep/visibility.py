# SPDX-License-Identifier: Apache-2.0
"""Visibility: the vertices that each camera sees of the icosphere of its image."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.icosphere import icosphere_vertices
from sphericalvision.shapes import check_shapes

if TYPE_CHECKING:
    from sphericalvision.cameras import CameraRig


def seen_in_view(rig: CameraRig, level: int) -> Bool[Tensor, "*b n V"]:
    """Return which vertices of its icosphere each camera sees, ``(*b, n, V)`` bool: its field of view less its mask.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> seen_in_view(ring_rig(4), level=3).sum(-1)  # of 642 vertices; 220 degrees are two thirds of the sphere
        tensor([432, 427, 432, 427])
    """
    poses = rig.world_from_camera
    far = torch.zeros(1, dtype=poses.dtype, device=poses.device)
    directions = icosphere_vertices(level, poses.dtype, poses.device)
    return rig.project_along(directions, far).valid.squeeze(-2)


@check_shapes
def check_seen(
    seen: Bool[Tensor, "#B n V"] | Bool[Tensor, "n V"], images: Float[Tensor, "B n C V"]
) -> Bool[Tensor, "B n V"]:
    """Return ``seen`` ``([B,] n, V)`` as ``(B, n, V)`` for images ``(B, n, C, V)``, or raise ``ShapeError``.

    Other types than bool are an ``ArgumentError``: masks of bytes would count 255 times.

    Examples:
        >>> check_seen(torch.ones(2, 42, dtype=torch.bool), torch.zeros(5, 2, 3, 42)).shape
        torch.Size([5, 2, 42])
    """
    # Not len(), which makes a constant of it for exports
    return seen.expand(images.shape[0], *seen.shape[-2:])
