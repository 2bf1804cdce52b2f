# SPDX-License-Identifier: Apache-2.0
"""The nearest hypothesis that is worth trying: the least depth of a scene, from a few sweeps."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import level_from_num_vertices
from sphericalvision.shapes import check_shapes
from sphericalvision.sweep.hypotheses import depth_from_index
from sphericalvision.sweep.semi_global import semi_global_sweep

if TYPE_CHECKING:
    from sphericalvision.cameras import CameraRig

ROUNDS, HYPOTHESES, SURE = 3, 32, 0.6
"""Number of sweeps, their hypotheses, and the confidence above which an index counts."""
QUANTILE, MARGIN = 0.005, 0.65
"""Share of the vertices that may be nearer, as a few false matches always are; factor of the depth of the others."""


@torch.no_grad()
@check_shapes
def nearest_depth(
    sphere_images: Float[Tensor, "B n 3 V_image"],
    rig: CameraRig,
    seen: Bool[Tensor, "B n V_image"] | Bool[Tensor, "n V_image"] | None = None,
) -> float:
    """Return the ``min_depth`` in metres for a sweep of these images, from a few quick sweeps.

    Hypotheses nearer than the scene are wasted, and make the steps between the others larger. The first sweep begins at
    1.2 times the rig's radius; each of the next a margin before the nearest sure surfaces of the sweep before.

    Args:
        sphere_images: ``(B, n, 3, V_image)`` in [-1, 1] on icospheres aligned with the world: frames of one scene, or
            of a sequence.
        rig: of the n cameras, for all frames.
        seen: ``([B,] n, V_image)``, True where the images show something.

    Raises:
        ArgumentError: if all cameras are in one place.

    Examples:
        >>> import math
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.data import ToSphere
        >>> from sphericalvision.scenes import make_scene, render_rig
        >>> rig = ring_rig(4, 0.05, (64, 64))
        >>> images = ToSphere(4).images(render_rig(make_scene("hall", seed=1), rig), rig)[None]
        >>> nearest_depth(images, rig) > 0.3  # a sweep of this rig would begin at 0.06 m
        True
    """
    radius = float((rig.positions - rig.center[..., None, :]).norm(dim=-1).max())
    if radius < 1e-6:
        raise ArgumentError(
            "rig: expected cameras in different places, got all in one: nothing tells depths apart"
        )
    level = max(level_from_num_vertices(sphere_images.shape[-1]) - 1, 0)
    nearest = least = 1.2 * radius
    for _ in range(ROUNDS):
        index, sure, both = semi_global_sweep(
            sphere_images, rig, HYPOTHESES, nearest, level=level, substeps=1, seen=seen
        )
        depths = depth_from_index(index, HYPOTHESES, nearest)
        certain, seen_twice = depths[both & (sure > SURE)], depths[both]
        if not len(certain):
            break
        # A bare floor is a surface without sure vertices: unsure ones count, too, with a larger share left out.
        surface = torch.minimum(certain.quantile(QUANTILE), seen_twice.quantile(4 * QUANTILE))
        distance = max(least, MARGIN * float(surface))
        if distance < 1.1 * nearest:
            return max(nearest, min(distance, nearest * 1.1))
        nearest = distance
    return nearest
