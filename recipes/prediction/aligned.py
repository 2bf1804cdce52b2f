# SPDX-License-Identifier: Apache-2.0
"""Cameras turned from what the calibration says, found in frames of a capture and turned back."""

from __future__ import annotations

import math
from pathlib import Path

from sphericalvision.cameras import CameraRig, read_rig, save_rig
from sphericalvision.capture import Predictor
from sphericalvision.capture.sources.frames import Source
from sphericalvision.recipes.app.cli import console

__all__ = ["aligned"]


def aligned(source: Source, predictor: Predictor, folder: Path, goes_on: bool) -> Predictor:
    """Turn the rig's cameras where three frames say so; the calibration goes to ``aligned.yaml`` in a folder.

    Whoever goes on with a prediction takes what is there.
    """
    kept = folder / "aligned.yaml"
    if goes_on:
        if not kept.is_file():
            return predictor
        source.rig = CameraRig(source.rig.cameras, read_rig(kept).world_from_camera, source.rig.masks)
        return predictor.with_rig(source.rig)
    with console.status("comparing frames with the calibration"):
        found = predictor.prepare(frame.images for frame in source.samples() if frame.images is not None)
    if found is None:
        return predictor
    turned = ", ".join(
        f"{name} by {math.degrees(turn):.2f}°"
        for name, turn in zip(found.rig.names, found.turns.norm(dim=-1).tolist(), strict=True)
    )
    before, after = found.agreement
    source.rig = found.rig.to("cpu")
    folder.mkdir(parents=True, exist_ok=True)
    save_rig(source.rig, kept)
    console.print(
        f"align=true turns {turned}: images agree better, {after:.3f} in place of {before:.3f} of 1. The calibration "
        f"is in {kept}",
        highlight=False,
        soft_wrap=True,
    )
    return predictor
