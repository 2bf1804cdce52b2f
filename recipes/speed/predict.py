# SPDX-License-Identifier: Apache-2.0
"""Prediction as it is used: frames a second of a ``Predictor``, and presets by cost and error."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import torch
from hydra import compose
from omegaconf import DictConfig
from torch import Tensor

from sphericalvision.cameras import ring_rig
from sphericalvision.capture import Predictor
from sphericalvision.capture.estimating import threads_kept
from sphericalvision.capture.preparation.preparation import AS_IT_IS
from sphericalvision.recipes.app.checks import typed
from sphericalvision.recipes.commands.predict import PredictConfig, predictor_for
from sphericalvision.recipes.evaluation.methods import SCALE
from sphericalvision.recipes.evaluation.places import FrameTruth
from sphericalvision.recipes.evaluation.track_frames import Size, TrackFrame, render_frame
from sphericalvision.recipes.evaluation.tracks import TRACKS
from sphericalvision.recipes.speed.measuring import Comparison, added_memory
from sphericalvision.scenes import make_scene, render_rig
from sphericalvision.sweep import index_from_inverse_depth

__all__ = ["fps", "presets"]

CONDITIONS = {
    "clean": ("clean",),
    "disturbed": ("together",),
    "other worlds": ("patchwork", "rough", "glazed"),
}
"""What presets are compared in -> tracks of the comparison of methods, in turns; no training uses their scenes."""

THREADS = (1, 2)
IMAGE_ROWS = 512
"""Of the images that presets are compared with: what the finest of them is for."""
FIRST = 56
"""Of their scenes: those before had a part in the choice of weights that ship."""


def fps(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """A call of a ``Predictor`` by size of the images, preset, and threads."""
    for side in config.image_sides:
        rig = ring_rig(4, image_size=(side, side))
        images = render_rig(make_scene("room", seed=1), rig)
        runs = {}
        for preset in config.presets:
            predictor = predictor_for(rig, preset_config(preset, device))
            for threads in THREADS if device.type == "cpu" else (1,):
                runs[f"{preset}, {threads} threads"] = partial(_on_threads, predictor, images, threads)
        yield Comparison(f"Predictor: a frame of four images of {side} x {side}", runs)


def presets(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Speed against accuracy: presets on ``config.num_frames`` scenes of each condition, four images each."""
    side = min(IMAGE_ROWS, max(config.image_sides))
    size = Size(image_rows=side, preparation=AS_IT_IS)
    frames = {
        name: [
            render_frame(TRACKS[tracks[i % len(tracks)]], FIRST + i, size) for i in range(config.num_frames)
        ]
        for name, tracks in CONDITIONS.items()
    }
    first = next(iter(frames.values()))[0]
    runs = {}
    for preset in config.presets:
        predictor = predictor_for(first.rig, preset_config(preset, device))
        errors = ", ".join(f"{name} {_error(predictor, each):.2f}" for name, each in frames.items())
        run = partial(predictor, first.images)
        run()  # tables of the rig, once
        held = f"; {added_memory(run, device):.0f} MB" if config.memory else ""
        runs[f"{preset}: {errors}{held}"] = partial(_on_threads, predictor, first.images, 1)
    note = "Mean error at level 4 where two cameras see, % of N = 16; memory that a frame adds; one thread"
    yield Comparison(f"presets, {config.num_frames} scenes a condition", runs, note)


def _error(predictor: Predictor, frames: Sequence[TrackFrame]) -> float:
    """Mean absolute error of the index, percent of N."""
    errors = []
    for frame in frames:
        truth = FrameTruth(frame)
        ids = truth.coarse_ids[truth.regions["all"][truth.coarse_ids]]
        depth = predictor.with_changes(frame.rig)(frame.images)
        inverse_depth = depth.at(truth.fine.vertices[ids].to(depth.index))[0].cpu()
        index = index_from_inverse_depth(inverse_depth, *SCALE)
        errors.append((index - truth.index[ids]).abs().mean().item() * 100 / SCALE.num_hypotheses)
    return statistics.fmean(errors)


def preset_config(name: str, device: torch.device) -> PredictConfig:
    """The configuration of ``sphericalvision-predict`` under a preset, for scenes of natural size."""
    words = ["calibration=rig.yaml", "images=images", f"device={device.type}", "min_depth=0.55"]
    return typed(
        PredictConfig, compose("predict", words if name == "default" else [f"preset={name}", *words])
    )


def _on_threads(predictor: Predictor, images: Mapping[str, Tensor], threads: int) -> None:
    with threads_kept():
        torch.set_num_threads(threads)
        predictor(images)
