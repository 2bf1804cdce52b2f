# SPDX-License-Identifier: Apache-2.0
"""A folder of rendered frames that runs of ``sphericalvision-render`` fill together: all with the same settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig
from rich.progress import track

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.fingerprint import rig_fingerprint
from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.data.omnistereo.files import RELEASES, Release
from sphericalvision.data.omnistereo.ground_truth import read_ground_truth
from sphericalvision.io.images import read_image
from sphericalvision.recipes.app.cli import console

__all__ = ["RECORD", "check_settings", "missing_frames", "settings_of"]

RECORD = "rendered.yaml"
"""Beside the frames: how they were rendered."""


def settings_of(config: DictConfig, rig: CameraRig, release: str) -> dict[str, Any]:
    """What all frames of a folder have in common."""
    names = ("kind", "first_seed", "scale", "samples_per_pixel", "height", "min_depth")
    return {
        **{name: config[name] for name in names},
        "release": release,
        "rig": rig_fingerprint(rig, digits=6),
    }


def check_settings(folder: Path, settings: dict[str, Any], release: str) -> None:
    """Compare settings with those of the frames in a folder.

    Raises:
        ArgumentError: they differ, or the frames come from elsewhere.
    """
    path = folder / RECORD
    if not path.is_file():
        truths = folder / RELEASES[release].ground_truth_folder
        if truths.is_dir() and any(truths.iterdir()):
            raise ArgumentError(
                f"output: {folder} holds frames of which no {RECORD} tells how they were rendered; choose another "
                "folder, so that they do not mix"
            )
        return
    try:
        stored = yaml.safe_load(path.read_text())
        differ = {key: stored.get(key) for key in settings if stored.get(key) != settings[key]}
    except (yaml.YAMLError, AttributeError, UnicodeDecodeError) as error:
        raise FileFormatError(f"{path}: is damaged; choose another output=... folder ({error})") from None
    if differ:
        there = ", ".join(f"{key}={value}" for key, value in differ.items())
        here = ", ".join(f"{key}={settings[key]}" for key in differ)
        raise ArgumentError(
            f"output: {folder} holds frames rendered with {there}, this command says {here}; use the same to add "
            "frames, or choose another folder"
        )


def missing_frames(root: Path, frames: range, release: str, num_cameras: int) -> list[int]:
    """Frames of which ``root`` lacks a file, or holds one that cannot be read."""
    layout = RELEASES[release]

    def files_of(frame: int) -> list[Path]:
        images = [root / f"cam{number + 1}" / f"{frame:05d}.png" for number in range(num_cameras)]
        return [*images, root / layout.ground_truth_folder / f"{frame:05d}{layout.suffix}"]

    there = [frame for frame in frames if all(path.is_file() for path in files_of(frame))]
    reading = track(there, "reading what is there", console=console, disable=not there)
    whole = {frame for frame in reading if _can_be_read(files_of(frame), layout)}
    return [frame for frame in frames if frame not in whole]


def _can_be_read(files: list[Path], layout: Release) -> bool:
    """Whether images and, last, ground truth of a frame are whole: a disk that was full may have left them empty."""
    try:
        for path in files[:-1]:
            read_image(path)
        read_ground_truth(files[-1], layout.min_depth)
    except FileFormatError:
        return False
    return True
