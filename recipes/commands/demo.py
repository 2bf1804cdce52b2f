# SPDX-License-Identifier: Apache-2.0
"""Four rendered fisheye images to a depth map of the full sphere: ``python -m sphericalvision.recipes.demo``."""

from pathlib import Path
from typing import Any

import numpy as np
from pydantic.dataclasses import dataclass
from torch.utils.data import DataLoader

from sphericalvision.cameras import CameraRig
from sphericalvision.capture import Predictor
from sphericalvision.capture.outputs import save_frame
from sphericalvision.capture.panoramas import Panoramas
from sphericalvision.capture.result_folder import Settings
from sphericalvision.core import ArgumentError
from sphericalvision.data import SampleView, ToSphere, collate_samples
from sphericalvision.io.images import as_bytes, write_image
from sphericalvision.models import DepthNetwork
from sphericalvision.models.weights.checkpoints import read_network
from sphericalvision.recipes.app.cli import build, choose_device, console
from sphericalvision.recipes.app.kinds import STRICT, Count, Device, Number, Text
from sphericalvision.recipes.evaluation.loop import (
    SampleFrames,
    VertexErrors,
    evaluate,
    limit_text,
    mean_errors_by_method,
)
from sphericalvision.recipes.evaluation.methods import Method, Scale, baselines
from sphericalvision.recipes.evaluation.tables import Table, save_errors
from sphericalvision.scenes import World, WorldSamples
from sphericalvision.scenes.samples import recorded_sample
from sphericalvision.sweep import index_from_inverse_depth
from sphericalvision.viz import depth_panorama, error_panorama, sheet
from sphericalvision.viz.figure import strip


@dataclass(frozen=True, kw_only=True, config=STRICT)
class DemoConfig:
    """Keys of ``conf/demo.yaml``."""

    rig: Any
    output: Text
    kind: Text
    scene_seed: Number
    samples_per_pixel: Count
    height: Count
    baseline_scenes: Count
    train_seed: Number
    checkpoint: Text | None
    device: Device


def demo(config: DemoConfig, folder: Path) -> Table:
    """Render a scene, estimate its depth, write everything to ``folder`` and return the table."""
    folder.mkdir(parents=True, exist_ok=True)
    net = read_network(config.checkpoint).to(choose_device(config.device))
    if net.images != "sphere":
        raise ArgumentError(
            "checkpoint: the demonstration shows networks on the icosphere, "
            f"{config.checkpoint} is {type(net).__name__}"
        )
    rig: CameraRig = build(config.rig, "rig")
    with console.status(f"rendering {len(rig)} fisheye images of a {config.kind} (seed {config.scene_seed})"):
        world = World(rig, config.kind, net.min_depth, samples_per_pixel=config.samples_per_pixel)
        world.check_free_space(rig)
        frame = recorded_sample(world.frame(config.scene_seed), config.height)
    for name, image in frame["images"].items():
        write_image(folder / f"input_{name}.png", image)
    with console.status(f"estimating depth: level {net.level}, {net.num_hypotheses} hypotheses"):
        sample = ToSphere(net.image_level, net.level - 2, antialias=True)(frame)
        panoramas = Panoramas(Predictor(rig, net, min_depth=net.min_depth)(frame["images"]), config.height)
        save_frame(folder, "", panoramas, Settings(["depth", "cloud", "npz"], config.height))
        _save_comparison(folder, frame, panoramas, net)
    seeds = range(config.train_seed, config.train_seed + config.baseline_scenes)
    depths = WorldSamples(world, SampleView(depth_level=net.level - 2), seeds)
    scale = Scale(net.num_hypotheses, net.min_depth)
    methods = [
        Method(type(net).__name__, net),
        *baselines(scale, net.level, DataLoader(depths, batch_size=8, collate_fn=collate_samples))[:3],
    ]
    measure = VertexErrors(scale, net.level - 2, net.device)
    records = evaluate(methods, SampleFrames(lambda _: [collate_samples([sample])], 1), measure)
    title = f"errors of this scene, percent of N = {net.num_hypotheses}; AbsRel, d<1.25 {limit_text('auto')}"
    table = save_errors(folder / "metrics", title, mean_errors_by_method(records))
    console.print("\nResults:")
    for name, meaning in CONTENTS.items():
        console.print(f"  {name:18} {meaning}", highlight=False, soft_wrap=True)
    print(folder)
    return table


def _save_comparison(folder: Path, frame: dict[str, Any], panoramas: Panoramas, net: DepthNetwork) -> None:
    """Ground truth and error as pictures, and everything side by side."""
    count, truth = net.num_hypotheses, frame["inverse_depth"]
    estimate = index_from_inverse_depth(panoramas.panorama.depth.reciprocal(), count, net.min_depth)
    error = (estimate - index_from_inverse_depth(truth, count, net.min_depth)).abs() * (100 / count)
    true = depth_panorama(truth.reciprocal(), panoramas.near)
    wrong = error_panorama(error, max_error=10.0, label=f"error (% of N = {count})")
    write_image(folder / "ground_truth.png", true)
    write_image(folder / "error.png", wrong)
    colors = as_bytes(panoramas.colors[0].cpu())
    larger = true.shape[1] // colors.shape[1]  # pictures with a scale are enlarged if they are small
    pictures = {
        "the images as one panorama": colors.repeat(larger, 0).repeat(larger, 1),
        "estimated depth": panoramas.depth_picture,
        "error": wrong,
        "true depth": true,
    }
    below = sheet(pictures, columns=2)
    images = strip([as_bytes(image) for image in frame["images"].values()], below.shape[1] - 24)
    write_image(folder / "overview.png", np.concatenate((sheet({"input": images})[:-12], below)))


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
