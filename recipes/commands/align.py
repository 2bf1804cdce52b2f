# SPDX-License-Identifier: Apache-2.0
"""Orientations of a rig's cameras from its own images: the work behind ``sphericalvision-align``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.progress import track

from sphericalvision.cameras import CameraRig, save_rig
from sphericalvision.cameras.calibration import RIG_FORMATS
from sphericalvision.capture import RayMatcher, RayMatches, align_rig
from sphericalvision.capture.calibrating.align import AlignedRig
from sphericalvision.capture.checks import pose_agreement
from sphericalvision.capture.photographs import as_photographs
from sphericalvision.capture.sources.frames import Selection
from sphericalvision.capture.sources.opening import spread_evenly
from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.recipes.app.captures import open_capture
from sphericalvision.recipes.app.cli import console, print_table

__all__ = ["align"]

HELD_OUT = 3
"""Most frames that judge and are not matched."""


def align(config: DictConfig) -> AlignedRig | None:
    """Match the images of some frames, turn the cameras, and write ``config.output`` if other frames agree better.

    Raises:
        ArgumentError: too little matches, or a key makes no sense; the message names it.
        FileFormatError: an image cannot be read.
    """
    if config.format is not None:
        check_choice("format", config.format, RIG_FORMATS)
    source = open_capture(config)
    rig = source.rig
    if len(rig) < 2:
        raise ArgumentError("cameras: expected two or more that see the same things, got one")
    names = source.names(Selection(config.start, config.stop, config.every))
    if names is None:
        raise ArgumentError("images: expected a recording, not live cameras")
    chosen = spread_evenly(names, config.num_frames)
    judges = chosen[1::3][:HELD_OUT] or chosen
    matched = [name for name in chosen if name not in judges] or chosen
    images = _read(source, [*matched, *judges])
    matcher = RayMatcher(rig)
    matches = RayMatches.joined(
        [matcher(images[name]) for name in track(matched, "matching", console=console)]
    )
    result = align_rig(rig, matches, expected=math.radians(config.expected_deg))
    before, after = (_agreement(images, judges, other) for other in (rig, result.rig))
    _print(result, matches, len(matched))
    where = "frames that were not matched" if set(judges) - set(matched) else "the frame itself"
    console.print(f"photo-consistency of {where}: {before:.3f} before, {after:.3f} after")
    if after <= before:
        print("Images agree no better with the cameras turned: the calibration stays, nothing is written.")
        return None
    Path(config.output).parent.mkdir(parents=True, exist_ok=True)
    save_rig(result.rig, config.output, config.format)
    print(config.output)
    return result


def _read(source: Any, wanted: list[str]) -> dict[str, Mapping[str, Any]]:
    found: dict[str, Mapping[str, Any]] = {}
    for frame in source.frames(Selection(), lambda name: name in wanted):
        if frame.images is None:
            raise frame.error
        found[frame.name] = as_photographs(frame.images, source.rig)
    return found


def _agreement(images: Mapping[str, Mapping[str, Any]], names: list[str], rig: CameraRig) -> float:
    return sum(pose_agreement(images[name], rig) for name in names) / len(names)


def _print(result: AlignedRig, matches: RayMatches, frames: int) -> None:
    rows = []
    for place, name in enumerate(result.rig.names):
        mine = ((matches.first == place) | (matches.second == place)) & result.inliers
        turn, spread = float(result.turns[place].norm()), float(result.spread[place])
        miss = float(result.misses[mine].square().mean().sqrt())
        degrees = (f"{math.degrees(value):.3f}" for value in (turn, spread, miss))
        rows.append([name, *degrees, str(int(mine.sum()))])
    header = ["camera", "turned (°)", "± (°)", "rays miss (°)", "pairs"]
    print_table(
        f"{int(result.inliers.sum())} of {len(matches.first)} pairs of {frames} frame(s) agree", header, rows
    )
