# SPDX-License-Identifier: Apache-2.0
"""Orientations of a rig's cameras from its own images: the work behind ``sphericalvision-align``."""

import math
import time
from collections.abc import Mapping, Sequence

import torch
from pydantic.dataclasses import dataclass
from torch import Tensor

from sphericalvision.cameras import CameraRig, save_rig
from sphericalvision.cameras.calibration import RIG_FORMATS
from sphericalvision.cameras.remapping.lookup import pixels_a_radian
from sphericalvision.capture import Predictor, align_rig, calibrate_photometry
from sphericalvision.capture.alignment import LEVEL, RigTurns
from sphericalvision.capture.sources.frames import spread_evenly
from sphericalvision.core import check_choice
from sphericalvision.icosphere import icosphere_vertices
from sphericalvision.recipes.app.captures import Capture, recorded_names, recorded_photographs
from sphericalvision.recipes.app.cli import choose_device, console, print_table
from sphericalvision.recipes.app.kinds import STRICT, Count, Device, Text


@dataclass(frozen=True, kw_only=True, config=STRICT)
class AlignConfig:
    """Keys of ``conf/align.yaml``."""

    capture: Capture
    num_frames: Count
    device: Device
    check: bool
    output: Text
    format: Text | None


def align(config: AlignConfig) -> RigTurns:
    """Judge a calibration by some frames, as ``predict`` does, and write ``config.output`` if cameras are turned."""
    if config.format is not None:
        check_choice("format", config.format, RIG_FORMATS)
    source = config.capture.open()
    names = recorded_names(source, config.capture.selection)
    config.capture.restrict(source)
    chosen = spread_evenly(names, config.num_frames)
    frames = [images for _, images in recorded_photographs(source, chosen)]
    start = time.perf_counter()
    with console.status(f"comparing {len(frames)} frame(s) with the calibration"):
        result = align_rig(Predictor(source.rig, level=LEVEL, device=choose_device(config.device)), frames)
    _print(source.rig, result, frames)
    print(f"alignment {result.described()} ({len(frames)} frame(s), {time.perf_counter() - start:.1f} s).")
    if not config.check and result.turned:
        save_rig(result.rig.to("cpu"), config.output, config.format)
        print(config.output)
    return result


def _print(rig: CameraRig, result: RigTurns, frames: Sequence[Mapping[str, Tensor]]) -> None:
    """Print a row for each camera: its rotation, overlap with others, exposure, resolution, and what to do."""
    light = calibrate_photometry(
        rig, {name: torch.stack([frame[name] for frame in frames]) for name in rig.names}
    )
    directions = icosphere_vertices(LEVEL).to(rig.world_from_camera)
    seen = rig.project_along(directions, directions.new_zeros(1)).valid[:, 0]
    rows = []
    for index, (name, camera) in enumerate(rig.cameras.items()):
        angle, spread = (
            math.degrees(float(values[index])) for values in (result.turns.norm(dim=-1), result.spread)
        )
        pixels = seen[index]
        shared = float((pixels & (seen.sum(0) > 1)).sum() / pixels.sum().clamp(min=1))
        exposure = float(light.exposure[index].mean().exp())
        resolution = math.radians(pixels_a_radian(camera))
        doubtful = result.reason and (angle + 2 * spread >= math.degrees(result.within) - 1e-6)
        advice = "turn" if name in result.turned else "look" if doubtful else ""
        numbers = (
            f"{angle:.2f}",
            f"{2 * spread:.2f}",
            f"{100 * shared:.0f} %",
            f"{exposure:.2f}",
            f"{resolution:.1f}",
        )
        rows.append([name, *numbers, advice])
    header = ["camera", "turned (°)", "± (°)", "shared", "light", "pixels/°", "do"]
    print_table("the calibration, as images see it", header, rows)
