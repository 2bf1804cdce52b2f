# SPDX-License-Identifier: Apache-2.0
"""Frames of a ``Predictor``, by size and preset, with their errors; and of the renderer."""

import itertools
import statistics
from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import torch
from hydra import compose
from omegaconf import DictConfig
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import Predictor
from sphericalvision.capture.predictor import threads_kept
from sphericalvision.capture.preparation.preparation import AS_IT_IS
from sphericalvision.recipes.app.checks import typed
from sphericalvision.recipes.commands.predict import PredictConfig, predictor_for
from sphericalvision.recipes.evaluation.methods import SCALE
from sphericalvision.recipes.evaluation.places import FrameTruth
from sphericalvision.recipes.evaluation.track_frames import Size, TrackFrame, render_frame
from sphericalvision.recipes.evaluation.tracks import TRACKS
from sphericalvision.recipes.speed.measuring import Comparison, Run, added_memory
from sphericalvision.scenes import make_scene, render_rig
from sphericalvision.scenes.registry import scene_kinds
from sphericalvision.sweep import index_from_inverse_depth

CONDITIONS = {
    "clean": ("clean",),
    "disturbed": ("together",),
    "other worlds": ("patchwork", "rough", "glazed"),
}
"""Conditions that presets are compared in -> tracks of the benchmark, in turns; no training uses their scenes."""

THREADS = (1, 2)
IMAGE_ROWS = 512
"""Rows of the images that presets are compared with: the size that the finest of them is for."""
FIRST = 56
"""Number of their first scene: earlier ones had a part in the choice of weights that ship."""


def data(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Rendering of ``num_frames`` seeds in turn, scenes included."""
    height, width = config.image_size
    rig = ring_rig(4, image_size=(height, width))

    def render(kind: str, seeds: Iterator[int]) -> object:
        return render_rig(make_scene(kind, next(seeds)), rig)

    yield Comparison(
        f"rendering: four images of {height} x {width}, one ray a pixel",
        {kind: partial(render, kind, itertools.cycle(range(config.num_frames))) for kind in scene_kinds()},
    )


def fps(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """A call of a ``Predictor`` by size of the images, preset, and threads."""
    for side in config.image_sides:
        rig = ring_rig(4, image_size=(side, side))
        images = render_rig(make_scene("room", seed=1), rig)
        predictors = {name: preset_predictor(name, rig, device) for name in config.presets}
        runs: dict[str, Run] = {
            f"{name}, {threads} threads": partial(_on_threads, predictor, images, threads)
            for name, predictor in predictors.items()
            for threads in (THREADS if device.type == "cpu" else (1,))
        }
        yield Comparison(f"Predictor: a frame of four images of {side} x {side}", runs)


def presets(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Speed against accuracy: presets on ``config.num_frames`` scenes of each condition, four images each."""
    size = Size(image_rows=min(IMAGE_ROWS, max(config.image_sides)), preparation=AS_IT_IS)
    frames = {
        name: [
            render_frame(TRACKS[tracks[i % len(tracks)]], FIRST + i, size) for i in range(config.num_frames)
        ]
        for name, tracks in CONDITIONS.items()
    }
    first = next(iter(frames.values()))[0]
    predictors = {name: preset_predictor(name, first.rig, device) for name in config.presets}
    for condition, scenes in frames.items():
        yield Comparison(
            f"presets: mean error at level 4 where two cameras see, {config.num_frames} {condition} scenes",
            {name: partial(_error, predictor, scenes) for name, predictor in predictors.items()},
            unit="% of N",
        )
    calls = {name: partial(_on_threads, predictor, first.images, 1) for name, predictor in predictors.items()}
    yield Comparison("presets: a frame, one thread", calls)
    memory = {name: partial(added_memory, run, device) for name, run in calls.items()}
    yield Comparison("presets: memory that a frame adds", memory, unit="MB")


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


def preset_predictor(name: str, rig: CameraRig, device: torch.device) -> Predictor:
    """The predictor of ``sphericalvision-predict`` under a preset, for scenes of natural size."""
    overrides = ["calibration=rig.yaml", "images=images", f"device={device.type}", "min_depth=0.55"]
    config = compose("predict", overrides if name == "default" else [f"preset={name}", *overrides])
    return predictor_for(rig, typed(PredictConfig, config))


def _on_threads(predictor: Predictor, images: Mapping[str, Tensor], threads: int) -> None:
    with threads_kept():
        torch.set_num_threads(threads)
        predictor(images)
