# SPDX-License-Identifier: Apache-2.0
"""The nearest hypothesis that a network is used with: given, as trained, or found in images."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import DepthNetwork
from sphericalvision.sphere.intake import Intake
from sphericalvision.sweep.hypotheses import check_hypotheses
from sphericalvision.sweep.nearest_depth import nearest_depth

SCENE_LEVEL = 6
"""Icosphere level of the images that the nearest depth of a scene is looked for in."""
FAR_OFF = 4.0
"""Factor by which the nearest hypothesis of a scene differs from that of a training, if hypotheses are to follow it.

What is found in images is between half and twice the right one, and in one of fifty scenes much farther.
"""
NEARER, FARTHER = 0.1, 1000.0
"""Radii of a rig between which its nearest hypothesis lies: nearer is within, farther nothing moves by a pixel."""
LARGEST = 2.0
"""Radii, in those of the usual rig, up to which rigs were in a training with rigs of many."""


class NearestHypothesis(NamedTuple):
    """Where hypotheses begin.

    Attributes:
        metres: where that is known without images.
        usual: metres, where to begin if a scene is neither much nearer nor much farther.
    """

    metres: float | None
    usual: float | None = None

    def in_frames(self, frames: Iterable[Mapping[str, Float[Tensor, "3 _ _"]]], rig: CameraRig) -> float:
        """Return the nearest depth in metres that suits what a few frames show, from quick sweeps.

        Args:
            frames: camera name -> ``(3, h, w)`` in [0, 1].
            rig: unbatched.

        Examples:
            >>> from sphericalvision.cameras import ring_rig
            >>> from sphericalvision.scenes import make_scene, render_rig
            >>> rig = ring_rig(3, radius=0.05, image_size=(32, 32))
            >>> NearestHypothesis(None).in_frames([render_rig(make_scene("hall", seed=1), rig)], rig) > 0.06
            True
        """
        intake = Intake(rig, Icosphere(SCENE_LEVEL))
        metres = nearest_depth(torch.stack([intake(frame) for frame in frames]), rig, intake.seen)
        if self.usual is None or not metres / FAR_OFF <= self.usual <= metres * FAR_OFF:
            return metres
        return self.usual


def nearest_hypothesis(
    min_depth: float | Literal["auto", "scene"] | None,
    net: DepthNetwork,
    rig: CameraRig,
    trained: bool = True,
) -> NearestHypothesis:
    """Return where hypotheses begin.

    Args:
        min_depth: metres; ``"scene"``: found in images; ``None``: as the network was trained, scaled with the rig if it
            is larger than those of the training, or if they all were of one radius; ``"auto"``: as ``None``, but found
            in images where nothing was trained, or where they show a scene four times nearer or farther than those
            that a network for rigs of many radii was trained with.
        net: the network.
        rig: unbatched.
        trained: whether the network, not a method without training in its place, is to estimate.

    Raises:
        ArgumentError: for anything else, and for cameras in one place, unless metres are given.
    """
    follows = net.min_depth_follows if trained else "scene"
    radius = float(rig.radius)
    if min_depth not in ("auto", "scene", None):
        metres = checked_min_depth(min_depth)
        if radius > 1e-6 and not NEARER < metres / radius < FARTHER:
            doubt = f"min_depth: {metres:g} m are {metres / radius:.2g} radii of the rig; are these metres?"
            warnings.warn(doubt, stacklevel=3)
        return NearestHypothesis(metres)
    check_places(rig)
    if min_depth == "scene" or (min_depth == "auto" and follows == "scene"):
        return NearestHypothesis(None)
    # Scaling a rig and everything around it changes no image: a network that was trained with one ring of cameras
    # serves any larger or smaller rig once its nearest hypothesis is scaled alike.
    scaled = net.min_depth * radius / net.trained_radius
    if follows != "training":
        return NearestHypothesis(scaled)
    usual = max(net.min_depth, scaled / LARGEST)
    return NearestHypothesis(usual) if min_depth is None else NearestHypothesis(None, usual)


def check_places(rig: CameraRig) -> None:
    """Raise ``ArgumentError`` if all cameras are in one place; poses that are inverted may be why."""
    if float(rig.radius) > 1e-6:
        return
    other = float(rig.replaced(world_from_camera=rig.camera_from_world).radius)
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


def frames_of(images: Mapping[str, Tensor]) -> list[dict[str, Tensor]]:
    """One dictionary a frame of images ``(*b, 3, h, w)``: the first, the middle and the last of a batch."""
    first = next(iter(images.values()))
    if first.ndim == 3:
        return [dict(images)]
    chosen = sorted({0, len(first) // 2, len(first) - 1})
    return [{name: image[frame] for name, image in images.items()} for frame in chosen]


def checked_min_depth(min_depth: Any) -> float:
    """Return metres, or raise ``ArgumentError`` for what is no positive number."""
    if isinstance(min_depth, bool) or not isinstance(min_depth, int | float):
        raise ArgumentError(
            f"min_depth: expected a positive number of metres, 'auto', 'scene' or None (as trained), got {min_depth!r}"
        )
    check_hypotheses(2, min_depth)
    return float(min_depth)
