# SPDX-License-Identifier: Apache-2.0
"""Scenes and trainings as small as they get."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from hydra import compose, initialize_config_module
from omegaconf import DictConfig
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig, save_rig
from sphericalvision.io.images import write_image


def typed(line: str) -> tuple[str, ...]:
    """The words of a command line."""
    return tuple(shlex.split(line))


TINY_SCENES = (
    *typed("rig.image_size=[32,32] data.num_train=3 data.num_val=2 data.num_test=2"),
    *typed("data.samples_per_pixel=1 data.batch_size=2 data.num_workers=0"),
)
TINY_TRAINING = (
    *typed("experiment=quickstart model.level=3 model.num_hypotheses=4 model.feature_channels=2"),
    *TINY_SCENES,
    *typed("trainer.val_check_interval=1 trainer.accelerator=cpu scheduler=constant"),
)
TINY_BENCHMARK = (
    *typed("tracks=[room] frames=1 level=3 panorama_rows=8 image_rows=16 align=false"),
    *typed("samples_per_pixel=1 workers=0 panel_height=20"),
)

Run = Callable[..., str]
"""Runs a command by its name and words; gives what it printed."""


def composed(command: str, *words: str) -> DictConfig:
    """The configuration of a command with these words."""
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        return compose(command, list(words))


def write_capture(
    folder: Path, rig: CameraRig, *frames: Mapping[str, Tensor], file: str = "{camera}/{frame}.png"
) -> Path:
    """A rig's calibration as ``rig.yaml``, and its images, frame by frame; gives the folder."""
    save_rig(rig, folder / "rig.yaml")
    for frame, images in enumerate(frames):
        for name, image in images.items():
            write_image(folder / file.format(camera=name, frame=frame), image)
    return folder


PLATED = ring_rig(4, image_size=(96, 96))


def write_plated_capture(folder: Path) -> Path:
    """Ten frames of a rig that moves, with a dark plate that stands still in the pictures of cam2; gives the folder."""
    drawn, frames = np.random.default_rng(0), []
    for _ in range(10):
        blurred = {name: cv2.GaussianBlur(drawn.random((96, 96)), (0, 0), 3.0) for name in PLATED.names}
        frames.append({n: torch.from_numpy(4 * (b - 0.5) + 0.5).float()[None] for n, b in blurred.items()})
        frames[-1]["cam2"][:, 66:, 18:78] = 0.1
    return write_capture(folder, PLATED, *frames)


def write_streams(path: Path, videos: Sequence[Sequence[np.ndarray]], codec: str = "mpeg4") -> None:
    """Videos of five frames a second as streams of one file: MP4, Matroska with the codec FFV1, or AVI with MJPEG."""
    import av

    formats = {"mpeg4": ("mp4", "yuv420p"), "ffv1": ("matroska", "bgr0"), "mjpeg": ("avi", "yuvj420p")}
    container, pixels = formats[codec]
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", format=container) as file:
        targets: list[Any] = [file.add_stream(codec, rate=5) for _ in videos]
        for target, (first, *_) in zip(targets, videos, strict=True):
            target.height, target.width = first.shape[:2]
            target.pix_fmt, target.bit_rate = pixels, 8_000_000
        for pictures in zip(*videos, strict=True):
            for target, picture in zip(targets, pictures, strict=True):
                file.mux(target.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        for target in targets:
            file.mux(target.encode(None))


def command_after(printed: str, label: str) -> list[str]:
    """The words of the command line that was printed behind a label."""
    (line,) = (line for line in printed.splitlines() if line.startswith(label))
    return shlex.split(line.removeprefix(label))
