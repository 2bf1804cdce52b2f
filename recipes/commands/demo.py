# SPDX-License-Identifier: Apache-2.0
"""Four rendered fisheye images to a depth map of the full sphere: ``python -m sphericalvision.recipes.demo``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor
from torch.utils.data import DataLoader

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.data import ToSphere, collate_samples
from sphericalvision.deploy import Predictor
from sphericalvision.io.images import write_image
from sphericalvision.models import DepthNetwork
from sphericalvision.recipes.app.checkpoints import load_network
from sphericalvision.recipes.app.cli import build, choose_device, console
from sphericalvision.recipes.app.frames import RenderedFrames, SceneDepths
from sphericalvision.recipes.evaluation.inputs import VertexEstimator
from sphericalvision.recipes.evaluation.tables import (
    Row,
    constant_estimators,
    evaluate,
    print_rows,
    save_rows,
    sweep_estimator,
)
from sphericalvision.recipes.prediction.outputs import Settings, Views, save_views
from sphericalvision.sweep import index_from_inverse_depth
from sphericalvision.viz import depth_panorama, error_panorama, sheet

__all__ = ["demo"]

NATURAL_MIN_DEPTH = 0.55
"""Metres: the nearest hypothesis that scenes of scale 1 are made for."""


def demo(config: DictConfig, folder: Path) -> list[Row]:
    """Render a scene, estimate its depth, write everything to ``folder`` and return the table."""
    folder.mkdir(parents=True, exist_ok=True)
    net = load_network(config.checkpoint).to(choose_device(config.device))
    if net.images != "sphere":
        raise ArgumentError(
            "checkpoint: the demonstration shows networks on the icosphere, "
            f"{config.checkpoint} is {type(net).__name__}"
        )
    scale = net.min_depth / NATURAL_MIN_DEPTH
    rig: CameraRig = build(config.rig, "rig")
    with console.status(f"rendering {len(rig)} fisheye images of a {config.kind} (seed {config.scene_seed})"):
        frames = RenderedFrames(
            rig, [1], config.scene_seed, config.kind, config.samples_per_pixel, config.height, scale
        )
        frame = frames[0]
    for name, image in frame["images"].items():
        write_image(folder / f"input_{name}.png", image)
    with console.status(f"estimating depth: level {net.level}, {net.num_hypotheses} hypotheses"):
        sample = ToSphere(net.level, antialias=True)(frame)
        views = Views(Predictor(rig, net, min_depth=net.min_depth)(frame["images"]), config.height)
        save_views(folder, "", views, Settings(["depth", "cloud", "npz"], config.height))
        _save_comparison(folder, frame, views.panorama.depth, net)
    depths = SceneDepths(rig, config.baseline_scenes, net.level, config.train_seed, config.kind, scale)
    rows = _table(net, sample, DataLoader(depths, batch_size=8))
    print_rows(f"errors of this scene, percent of N = {net.num_hypotheses} (smaller is better)", rows)
    save_rows(folder / "metrics", rows)
    _print_contents(folder)
    return rows


def _save_comparison(folder: Path, frame: dict[str, Any], depth: Tensor, net: DepthNetwork) -> None:
    """Ground truth and error as pictures, and everything side by side."""
    number, min_depth = net.num_hypotheses, net.min_depth
    truth = frame["inverse_depth"]
    estimate = index_from_inverse_depth(depth.reciprocal(), number, min_depth)
    error = (estimate - index_from_inverse_depth(truth, number, min_depth)).abs() * (100 / number)
    pictures = {
        "ground truth": depth_panorama(truth.reciprocal(), min_depth),
        "error": error_panorama(error, max_error=10.0, label=f"error (% of N = {number})"),
    }
    write_image(folder / "ground_truth.png", pictures["ground truth"])
    write_image(folder / "error.png", pictures["error"])
    estimated = {"estimated depth": depth_panorama(depth, min_depth)}
    views = {name: (view * 255).byte().permute(1, 2, 0).numpy() for name, view in frame["images"].items()}
    overview = {"input": sheet(views, columns=2), **estimated, **pictures}
    write_image(folder / "overview.png", sheet(overview, columns=2))


def _table(net: DepthNetwork, sample: dict[str, Any], depths: DataLoader[dict[str, Any]]) -> list[Row]:
    """Errors of the network and of what it must beat."""
    estimators = {
        type(net).__name__: VertexEstimator(net),
        "photo-consistency sweep": sweep_estimator(net),
        **constant_estimators(depths, net),
    }
    with torch.inference_mode():
        return evaluate(estimators, [collate_samples([sample])], net)


CONTENTS = {
    "overview.png": "everything in one picture",
    "input_*.png": "the fisheye images",
    "depth.png": "estimated depth, equirectangular, with its scale in metres",
    "color.png": "the images as one panorama",
    "ground_truth.png": "true depth",
    "error.png": "where the two differ",
    "points.ply": "coloured point cloud, metres",
    "depth.npz": "arrays: index, depth, inverse_depth, directions, ...",
    "metrics.md": "the table above (also .json and .csv)",
}


def _print_contents(folder: Path) -> None:
    console.print("\nResults:")
    for name, meaning in CONTENTS.items():
        console.print(f"  {name:18} {meaning}", highlight=False, soft_wrap=True)
    print(folder)
