# SPDX-License-Identifier: Apache-2.0
"""What cameras see of the icospheres that their images are on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError, check_floating, check_tensor
from sphericalvision.geometry.directions import in_single_precision
from sphericalvision.icosphere import icosphere_vertices
from sphericalvision.kernels import prefer_fused

if TYPE_CHECKING:
    from sphericalvision.cameras import CameraRig

__all__ = ["check_seen", "images_in_single_precision", "one_at_a_time", "seen_in_view"]


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


def check_seen(
    seen: Bool[Tensor, "B n V"] | Bool[Tensor, "n V"], images: Float[Tensor, "B n C V"]
) -> Bool[Tensor, "B n V"]:
    """Return ``seen`` ``([B,] n, V)`` as ``(B, n, V)`` for images ``(B, n, C, V)``, or raise ``ShapeError``.

    What is not bool is an ``ArgumentError``: masks of bytes would count 255 times.

    Examples:
        >>> check_seen(torch.ones(2, 42, dtype=torch.bool), torch.zeros(5, 2, 3, 42)).shape
        torch.Size([5, 2, 42])
    """
    check_tensor("seen", seen, "(B, n, V) or (n, V)")
    if seen.dtype != torch.bool:
        raise ArgumentError(f"seen: expected bool, True where images show something, got {seen.dtype}")
    batch, num_cameras, num_vertices = (images.shape[dim] for dim in (0, 1, -1))
    shape = (batch, num_cameras, num_vertices)
    if seen.ndim not in (2, 3) or tuple(seen.shape) != shape[-seen.ndim :]:
        raise ShapeError(f"seen: expected shape {shape} or {shape[1:]}, got {tuple(seen.shape)}")
    return seen.expand(shape)


def images_in_single_precision(name: str, images: Float[Tensor, " ..."]) -> Float[Tensor, " ..."]:
    """Return images in float32 at least, or raise ``ArgumentError`` for integers.

    What costs are made of, differences and their squares, has no place in half precision.

    Examples:
        >>> images_in_single_precision("images", torch.zeros(2, dtype=torch.float16)).dtype
        torch.float32
    """
    check_floating(name, images)
    return in_single_precision(images)


def one_at_a_time(values: Tensor) -> bool:
    """Whether samples are computed one after the other, so that what belongs together stays in the cache of a CPU.

    Other devices and compilers want few large operations.
    """
    return not prefer_fused(values.device) and values.device.type == "cpu" and len(values) > 0
