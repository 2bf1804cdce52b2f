# SPDX-License-Identifier: Apache-2.0
"""The nearest hypothesis that a network is used with: given, as trained, or found in images."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.sphere_images import sphere_lookups
from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import icosphere_vertices
from sphericalvision.models import DepthNetwork
from sphericalvision.sweep.nearest_depth import nearest_depth

__all__ = ["SCENE_LEVEL", "check_places", "checked_min_depth", "nearest_in_frames", "scaled_min_depth"]

SCENE_LEVEL = 6
"""Icosphere level of the images that the nearest depth of a scene is looked for in."""


def nearest_in_frames(
    frames: Iterable[Mapping[str, Float[Tensor, "3 _ _"]]], rig: CameraRig, antialias: bool = True
) -> float:
    """Return the nearest depth in metres that suits what a few frames show, from quick sweeps.

    Args:
        frames: camera name -> ``(3, h, w)`` in [0, 1].
        rig: unbatched.
        antialias: as of ``Predictor``.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.data import make_scene, render_rig
        >>> rig = ring_rig(3, radius=0.05, image_size=(32, 32))
        >>> nearest_in_frames([render_rig(make_scene("hall", seed=1), rig)], rig) > 0.06
        True
    """
    vertices = icosphere_vertices(SCENE_LEVEL, torch.float32, rig.world_from_camera.device)
    lookups = sphere_lookups(rig, vertices.to(rig.world_from_camera), antialias)
    seen = torch.stack([look.seen for look in lookups])
    images = [
        torch.stack([look(frame[name], 0) for name, look in zip(rig.names, lookups, strict=True)])
        for frame in frames
    ]
    return nearest_depth(torch.stack(images).mul_(2).sub_(seen.unsqueeze(1).float()), rig, seen)


def scaled_min_depth(net: DepthNetwork, rig: CameraRig, trained_radius: float = 0.2) -> float:
    """Return the nearest hypothesis in metres that a network was trained with, scaled as the rig is.

    Scaling a rig and everything around it changes no image. A network that was trained with one ring of cameras serves
    any larger or smaller rig once its nearest hypothesis is scaled alike.

    Raises:
        ArgumentError: all cameras are in one place, so there is no size to scale by.
    """
    radius = float(rig.radius)
    check_places(rig)
    return net.min_depth * radius / float(trained_radius)


def check_places(rig: CameraRig) -> None:
    """Raise ``ArgumentError`` if all cameras are in one place; poses that are inverted may be why."""
    if float(rig.radius) > 1e-6:
        return
    other = float(CameraRig(rig.cameras, rig.camera_from_world).radius)
    hint = (
        f". Inverted, the poses have a radius of {other:.3f} m: the calibration seems to hold camera-from-world; "
        "CameraRig(rig.cameras, rig.camera_from_world) is the other way round"
        if other > 1e-6
        else ""
    )
    raise ArgumentError(
        f"rig: it has all its cameras in one place ({', '.join(rig.names)}), which gives neither parallax nor a scale; "
        f"correct the poses, or for a network of a single camera give metres, min_depth=0.55{hint}"
    )


def checked_min_depth(min_depth: Any) -> float:
    """Return metres, or raise ``ArgumentError`` for what is no positive number."""
    if (
        isinstance(min_depth, bool)
        or not isinstance(min_depth, int | float)
        or not 0 < min_depth < float("inf")
    ):
        raise ArgumentError(
            f"min_depth: expected a positive number of metres, 'scene' or None (as trained), got {min_depth!r}"
        )
    return float(min_depth)
