# SPDX-License-Identifier: Apache-2.0
"""Prediction as it is used: frames a second of a ``Predictor``, and from a video to a video."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path

import cv2
import torch
from omegaconf import DictConfig
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import Predictor, Preparation
from sphericalvision.capture.outputs import Outputs, Settings
from sphericalvision.capture.sources.frames import Selection
from sphericalvision.capture.sources.videos import Videos
from sphericalvision.recipes.benchmark.measuring import Comparison
from sphericalvision.recipes.commands.predict import run
from sphericalvision.scenes import make_scene, render_rig

__all__ = ["fps", "predict"]

PRESETS = {
    "default": ("refinedsweepnet", 6, 320),
    "fast": ("refinedsweepnet", 5, 160),
    "fine": ("refinedsweepnet-fine", 7, 320),
}
"""Name of a preset of ``sphericalvision-predict`` -> its weights, level of the images, rows of the panoramas."""

THREADS = (1, 2)


def fps(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """A call of a ``Predictor`` by size of the images, preset, compensation of light, and threads."""
    for side in config.image_sides:
        rig = ring_rig(4, image_size=(side, side))
        images = render_rig(make_scene("room", seed=1), rig)
        runs = {}
        for preset in config.presets:
            for light in (True, False):
                weights, level, _ = PRESETS[preset]
                preparation = Preparation(photometric=light)
                predictor = Predictor(
                    rig, weights, level=level, min_depth=0.55, device=device, preparation=preparation
                )
                for threads in THREADS if device.type == "cpu" else (1,):
                    name = f"{preset}, level {level}, light {'compensated' if light else 'as it is'}"
                    runs[f"{name}, {threads} threads"] = partial(_on_threads, predictor, images, threads)
        yield Comparison(f"Predictor: a frame of four images of {side} x {side}", runs)


def _on_threads(predictor: Predictor, images: Mapping[str, Tensor], threads: int) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        predictor(images)
    finally:
        torch.set_num_threads(before)


def predict(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Four fisheye views side by side in a video of ``config.num_frames`` frames, for the presets that stream."""
    rig = ring_rig(4, image_size=(config.image_sides[0], config.image_sides[0]))
    images = render_rig(make_scene("room", seed=1), rig)
    for preset in config.presets:
        weights, level, height = PRESETS[preset]
        predictor = Predictor(rig, weights, level=level, min_depth=0.55, device=device)
        with tempfile.TemporaryDirectory() as folder:
            video = Path(folder, "views.avi")
            _write_video(video, images, config.num_frames)
            runs = {
                "Predictor alone, frame after frame": partial(_alone, predictor, images, config.num_frames),
                "video to video": partial(_end_to_end, predictor, rig, video, height),
            }
            yield Comparison(f"predict, {preset}: level {level}, {config.num_frames} frames", runs)


def _alone(predictor: Predictor, images: Mapping[str, Tensor], number: int) -> None:
    for _ in range(number):
        predictor(images)


def _end_to_end(predictor: Predictor, rig: CameraRig, video: Path, height: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        outputs = Outputs(Path(folder), Settings(["video"], height))
        run(Videos({"": video}, rig), Selection(), predictor, outputs, None)


def _write_video(path: Path, images: Mapping[str, Tensor], number: int) -> None:
    row = (torch.cat(list(images.values()), -1) * 255).byte().movedim(0, -1).flip(-1).contiguous().numpy()
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (row.shape[1], row.shape[0]))
    for _ in range(number):
        writer.write(row)
    writer.release()
