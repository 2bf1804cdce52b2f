# SPDX-License-Identifier: Apache-2.0
"""Masks of the body that carries the rig, found in the frames of a capture: ``masks=auto``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.capture import find_own_body
from sphericalvision.capture.photographs import as_photographs
from sphericalvision.capture.preparation.own_body import MOST
from sphericalvision.capture.sources.frames import Selection, Source
from sphericalvision.core import ArgumentError
from sphericalvision.io.images import write_mask
from sphericalvision.recipes.prediction.sources import spread_evenly

__all__ = ["masked_by_itself", "with_own_body_masked"]


def masked_by_itself(source: Source, folder: Path) -> CameraRig:
    """The rig of a source with masks of its own body, which are written to ``masks/{camera}.png`` of a folder.

    Args:
        source: a recording; up to fifty frames of all of it are read, whichever are to be predicted.
        folder: of the results.

    Raises:
        ArgumentError: live cameras, which cannot be read twice.
    """
    if source.live:
        raise ArgumentError(
            "masks: auto reads the frames before the first is predicted, which live cameras do not allow; record "
            "some, predict with masks=auto, and give its masks: masks='.../masks/{camera}.png'"
        )
    names = source.names(Selection())
    wanted = None if names is None else set(spread_evenly(names, MOST))
    frames = source.frames(Selection(), lambda name: wanted is None or name in wanted)
    rig = with_own_body_masked(
        source.rig, (as_photographs(f.images, source.rig) for f in frames if f.images is not None)
    )
    for name, mask in rig.masks.items():
        write_mask(folder / "masks" / f"{name}.png", mask)
    return rig


def with_own_body_masked(rig: CameraRig, frames: Iterable[Mapping[str, Tensor]]) -> CameraRig:
    """The rig with masks of its own body, of which a line for each camera is printed."""
    found = find_own_body(rig, frames)
    for name, share in found.shares.items():
        why = "" if share else f" ({found.reason or 'no body was seen'})"
        print(f"mask of {name}: {100 * share:.1f} % of its picture{why}")
    return CameraRig(rig.cameras, rig.world_from_camera, found.masks)
