# SPDX-License-Identifier: Apache-2.0
"""Measure speed: ``sphericalvision-speed groups=[network]``.

Every figure is compared with another way to do the same work, run in turns with it; ratios are what counts.
"""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Literal

import torch
from annotated_types import MinLen
from omegaconf import DictConfig
from pydantic import with_config
from typing_extensions import TypedDict

from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.recipes.app.cli import choose_device, console
from sphericalvision.recipes.app.kinds import STRICT, Count, Device, Positive, Size, Text
from sphericalvision.recipes.speed.busy import busy
from sphericalvision.recipes.speed.cameras import cameras
from sphericalvision.recipes.speed.frames import data, fps, presets
from sphericalvision.recipes.speed.measuring import (
    MIN_ROUNDS,
    Comparison,
    Measurement,
    comparison_table,
    machine,
    measure,
    prepare_operators,
    save_measurements,
)
from sphericalvision.recipes.speed.networks import convolutions, gpu, network, variants


@with_config(STRICT)
class SpeedKeys(TypedDict, total=False):
    """Keys of ``conf/speed.yaml``."""

    output: Text
    groups: Annotated[list[str], MinLen(1)] | None
    only: Text | None
    seconds: Positive
    threads: Count | None
    device: Device
    settings: list[Size]
    feature_channels: Count
    image_size: Size
    options: list[str]
    num_frames: Count
    image_sides: Annotated[list[Count], MinLen(1)]
    presets: Annotated[list[Literal["default", "live", "fast", "fine", "finest"]], MinLen(1)]
    variants: list[Literal["icosweepnet", "icosweepnet_small", "icosweepnet_rt"]]
    convolution_settings: list[Size]
    num_points: Count


GROUPS: dict[str, Callable[[DictConfig, torch.device], Iterator[Comparison]]] = {
    group.__name__: group
    for group in (cameras, convolutions, network, variants, data, fps, presets, busy, gpu)
}


def measure_speed(
    config: Annotated[DictConfig, SpeedKeys], folder: Path, min_rounds: int = MIN_ROUNDS
) -> list[Measurement]:
    """Measure the groups that ``config`` names; the tables go to ``folder``."""
    for group in config.groups or ():
        check_choice("groups", group, tuple(GROUPS))
    try:
        pattern = re.compile(config.only or "")
    except re.error as error:
        raise ArgumentError(f"only: expected a regular expression, got {config.only!r}: {error}") from error
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    device = choose_device(config.device)
    prepare_operators(device)
    facts = machine(device)
    for key, value in facts.items():
        console.print(f"{key}: {value}", highlight=False)
    rows: list[Measurement] = []
    titles: list[str] = []
    for group in config.groups or (["network"] if device.type == "cpu" else ["gpu"]):
        for comparison in GROUPS[group](config, device):
            titles.append(comparison.title)
            if pattern.search(comparison.title):
                with console.status(comparison.title):
                    measured = measure(comparison, config.seconds, min_rounds)
                comparison_table(measured).print()
                rows += measured
                written = save_measurements(folder, rows, facts)  # an interruption loses little
    if not rows:
        raise ArgumentError(f"only: expected a part of a title, got {config.only!r}; there are {titles}")
    for path in written:
        print(path)
    return rows
