# SPDX-License-Identifier: Apache-2.0
"""Prediction from a video to a video: seconds a frame from end to end, beside the network alone."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import cv2
import torch
from omegaconf import DictConfig

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import Predictor
from sphericalvision.capture.estimating import MOST_WORKERS
from sphericalvision.capture.outputs import Outputs, Settings
from sphericalvision.capture.sources.frames import Selection
from sphericalvision.capture.sources.threads import side_by_side, threads_kept
from sphericalvision.capture.sources.videos import Videos
from sphericalvision.recipes.benchmark.measuring import Comparison
from sphericalvision.recipes.commands.predict import run
from sphericalvision.scenes import make_scene, render_rig

__all__ = ["comparisons"]

SIZE = (400, 400)
SETTINGS = {"default": (6, 320), "fast": (5, 160)}
"""Name -> level of the images, rows of the panoramas."""


def comparisons(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Four fisheye views side by side in a video, ``config.num_frames`` frames."""
    rig = ring_rig(4, image_size=SIZE)
    for name, (level, height) in SETTINGS.items():
        predictor = Predictor(rig, level=level, min_depth=0.55, device=device, native="auto")
        images = render_rig(make_scene("room", seed=1), rig)
        predictor(images)  # makes the tables
        yield Comparison(
            f"predict, {name}: level {level}, 4 x {SIZE[1]} x {SIZE[0]}, video to video, seconds a frame",
            {
                "network alone, all threads for a frame": partial(
                    _alone, predictor, images, config.num_frames, 1
                ),
                "network alone": partial(_alone, predictor, images, config.num_frames, MOST_WORKERS),
                "sphericalvision": _end_to_end(predictor, rig, images, height, config.num_frames),
            },
            "network alone",
            unit="reported s",
            rounds=2,
        )


def _alone(predictor: Predictor, images: dict[str, torch.Tensor], number: int, most: int) -> float:
    """Seconds a frame of the network, so many frames at most side by side."""
    with threads_kept() as threads:
        workers = min(threads, most, number)
        start = time.perf_counter()
        for _ in side_by_side(predictor, [images] * number, workers, threads // workers):
            pass
        return (time.perf_counter() - start) / number


def _end_to_end(
    predictor: Predictor, rig: CameraRig, images: dict[str, torch.Tensor], height: int, number: int
) -> Callable[[], float]:
    def measured() -> float:
        with tempfile.TemporaryDirectory() as folder:
            video = Path(folder, "views.avi")
            _write_video(video, images, number)
            outputs = Outputs(Path(folder, "out"), Settings(["video"], height))
            start = time.perf_counter()
            run(Videos({"": video}, rig), Selection(), predictor, outputs, None)
            return (time.perf_counter() - start) / number

    return measured


def _write_video(path: Path, images: dict[str, torch.Tensor], number: int) -> None:
    row = (torch.cat(list(images.values()), -1) * 255).byte().movedim(0, -1).flip(-1).contiguous().numpy()
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (row.shape[1], row.shape[0]))
    for _ in range(number):
        writer.write(row)
    writer.release()
