# SPDX-License-Identifier: Apache-2.0
"""Error against the share of points that is kept by confidence, one threshold for all scenes: the tables of the guide.

Run from the root of the repository: ``python docs/kept_share.py`` for the semi-global sweep, half a minute;
``python docs/kept_share.py refinedsweepnet`` for a network that ships, a minute. ``python docs/kept_share.py
refinedsweepnet room,glazed,meshes`` says it kind by kind, a few seconds each; ``meshes`` are made here, and are of a
kind that no training has seen.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import torch
import trimesh
from scipy.ndimage import zoom
from torch import Tensor
from trimesh.creation import cylinder, torus
from trimesh.transformations import random_rotation_matrix

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.data import SampleView
from sphericalvision.icosphere import Icosphere, level_from_num_vertices
from sphericalvision.models import DepthNetwork, pretrained
from sphericalvision.scenes import World, WorldSamples
from sphericalvision.scenes.meshes import MeshFiles, mesh_files
from sphericalvision.sweep import index_from_inverse_depth, semi_global_sweep

NUM_HYPOTHESES, MIN_DEPTH = 16, 0.55
SHARES = (1.0, 0.9, 0.8, 0.5)
LEAST_POINTS = 20
"""In a range of confidence, for a mean that says something."""
BOUNDS = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 1.01)


class Answers(NamedTuple):
    """Errors of the index and confidences ``(P,)``."""

    errors: Tensor
    confidences: Tensor


class Estimate(NamedTuple):
    """Index, confidence and where two cameras look ``(V,)``, at the vertices that carry the truth."""

    index: Tensor
    confidence: Tensor
    seen: Tensor


Method = Callable[[dict[str, Any], CameraRig], Estimate]


def by_sweep(sample: dict[str, Any], rig: CameraRig) -> Estimate:
    """The semi-global sweep."""
    images, seen = sample["images"][None], sample["seen"][None]
    found = semi_global_sweep(images, rig, NUM_HYPOTHESES, MIN_DEPTH, seen=seen)
    return Estimate(found.index[0], found.confidence[0], found.seen[0])


def by_network(net: DepthNetwork) -> Method:
    """A network, whose answers are at more vertices."""
    if (net.num_hypotheses, net.min_depth) != (NUM_HYPOTHESES, MIN_DEPTH):
        sys.exit(
            f"expected a network with N = {NUM_HYPOTHESES} from {MIN_DEPTH} m, got {net.hyperparameters}"
        )

    def estimate(sample: dict[str, Any], rig: CameraRig) -> Estimate:
        found = net.predict(
            sample["images"][None], net.tables(rig), sample["seen"][None]
        )
        vertices = Icosphere(level_from_num_vertices(len(sample["valid"]))).vertices
        index, confidence, seen = (
            net.index_at(values.float(), vertices)[0][0] for values in found
        )
        return Estimate(index, confidence, seen > 0.5)

    return estimate


def measured(
    method: Method,
    tilt_deg: float,
    num_scenes: int,
    kind: str | Sequence[str] = ("room", "floating"),
    meshes: MeshFiles | None = None,
    level: int = 6,
) -> Answers:
    """Answers at all points of held-out scenes that two cameras see."""
    rig = ring_rig(4, 0.2, (256, 256)).rotated(tilt=math.radians(tilt_deg))
    world = World(rig, kind, meshes=meshes, samples_per_pixel=2)
    view = SampleView(level, level - 2, antialias=True)
    scenes = WorldSamples(world, view, range(2_000_000, 2_000_000 + num_scenes))
    errors, confidences = [], []
    for sample in (scenes[number] for number in range(num_scenes)):
        found = method(sample, rig)
        truth = index_from_inverse_depth(
            sample["inverse_depth"], NUM_HYPOTHESES, MIN_DEPTH
        )
        counts = sample["valid"] & found.seen
        errors.append((found.index - truth).abs()[counts])
        confidences.append(found.confidence[counts])
    return Answers(torch.cat(errors), torch.cat(confidences))


def kept_table(answers: Answers) -> list[str]:
    """Errors of the surest points."""
    order = answers.confidences.argsort(descending=True)
    lines = [
        "| kept | confidence from | mean error, % of N | error below 1 |",
        "|---:|---:|---:|---:|",
    ]
    for share in SHARES:
        kept = order[: round(share * len(order))]
        errors = answers.errors[kept]
        mean, below = (
            100 / NUM_HYPOTHESES * errors.mean(),
            (errors < 1).float().mean(),
        )
        lines.append(
            f"| {share:.0%} | {answers.confidences[kept[-1]]:.2f} | {mean:.2f} | {below:.1%} |"
        )
    return lines


def said_table(answers: Answers, is_probability: bool) -> list[str]:
    """What the confidence says against what is so: a probability, or an expected error of up to two hypotheses."""
    head = "error below 1" if is_probability else "mean error, two at most"
    lines = [f"| confidence | points | {head} |", "|---|---:|---:|"]
    for low, high in pairwise(BOUNDS):
        inside = (answers.confidences >= low) & (answers.confidences < high)
        errors, said = answers.errors[inside], answers.confidences[inside].mean()
        share = f"| {low:.1f} to {min(high, 1):.1f} | {inside.float().mean():.0%} |"
        if is_probability:
            lines.append(
                f"{share} {(errors < 1).float().mean():.0%} (said {said:.0%}) |"
            )
        else:
            lines.append(
                f"{share} {errors.clamp(max=2).mean():.2f} (said {2 - 2 * said:.2f}) |"
            )
    return lines


def terrain(path: Path, seed: int) -> None:
    """Write hills with rings and leaning columns on them, in patterns of waves of all lengths, below an empty sky."""
    draw, side = np.random.default_rng(seed), 241
    octaves = [
        zoom(draw.normal(size=(cells, cells)) * 3 / cells, side / cells)
        for cells in (4, 9, 21, 41)
    ]
    x, z = np.meshgrid(*2 * [np.linspace(-9, 9, side)])
    ids = np.arange(side * side).reshape(side, side)
    corners = ids[:-1, :-1], ids[1:, :-1], ids[:-1, 1:], ids[1:, 1:]
    a, b, c, d = (corner.reshape(-1) for corner in corners)
    ground = np.stack((x, sum(octaves) - 1.5, z), -1).reshape(-1, 3)
    parts = [
        trimesh.Trimesh(
            ground, np.concatenate((np.stack((a, b, c), 1), np.stack((c, b, d), 1)))
        )
    ]
    for number in range(70):
        size = draw.uniform(0.2, 1.5)
        ring, column = (
            torus(size, size / 4, 48, 24),
            cylinder(size / 4, 4 * size, sections=32),
        )
        part = ring if number % 2 else column.subdivide().subdivide().subdivide()
        turn = random_rotation_matrix(draw.random(3))
        turn[:3, 3] = draw.uniform((-8, -1, -8), (8, 3, 8))
        parts.append(part.apply_transform(turn))
    for part in parts:
        waves = draw.normal(size=(3, 12)) * np.geomspace(0.5, 12, 12)
        bright = np.sin(part.vertices @ waves + draw.uniform(0, 6, 12)).mean(
            -1, keepdims=True
        )
        colors = (
            128 + 250 * bright * draw.uniform(0.3, 1, 3) + draw.uniform(-50, 50, 3)
        )
        part.visual.vertex_colors = colors.clip(0, 255).astype(np.uint8)
    trimesh.util.concatenate(parts).export(path)


def kinds_table(name: str, kinds: Sequence[str], num_scenes: int = 4) -> str:
    """What the confidence says against what is so, kind by kind, as Markdown; a threshold for all scenes of a kind."""
    heads = [f"{low:.1f} to {min(high, 1):.1f}" for low, high in pairwise(BOUNDS)]
    lines = [
        f"| kind | mean error, % of N | surest 80 % / all | {' | '.join(heads)} |",
        "|---|" + "---:|" * (2 + len(heads)),
    ]
    method = by_network(pretrained(name))
    with TemporaryDirectory() as folder:
        if "meshes" in kinds:
            for seed in range(num_scenes):
                terrain(Path(folder, f"{seed}.glb"), seed)
        for kind in kinds:
            meshes, usual = (
                (mesh_files(folder), "room") if kind == "meshes" else (None, kind)
            )
            found = measured(method, 0, num_scenes, usual, meshes)
            order = found.confidences.argsort(descending=True)
            surest = (
                found.errors[order[: round(0.8 * len(order))]].mean()
                / found.errors.mean()
            )
            cells = [
                f"{100 / NUM_HYPOTHESES * found.errors.mean():.2f}",
                f"{surest:.2f}",
            ]
            for low, high in pairwise(BOUNDS):
                inside = (found.confidences >= low) & (found.confidences < high)
                errors, said = (
                    found.errors[inside].clamp(max=2).mean(),
                    found.confidences[inside].mean(),
                )
                cells.append(
                    f"{errors:.2f} ({2 - 2 * said:.2f})"
                    if inside.sum() > LEAST_POINTS
                    else "–"
                )
            lines.append(f"| {kind} | {' | '.join(cells)} |")
            print(lines[-1], file=sys.stderr, flush=True)
    return "\n".join(lines)


def table(name: str | None = None, num_scenes: int = 12) -> str:
    """The lines of both tables, as Markdown."""
    method = by_sweep if name is None else by_network(pretrained(name))
    level_and_tilted = [measured(method, tilt, num_scenes) for tilt in (0, 30)]
    answers = Answers(*map(torch.cat, zip(*level_and_tilted, strict=True)))
    return "\n".join(
        [
            *kept_table(answers),
            "",
            *said_table(answers, is_probability=name is None),
        ]
    )


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    if len(sys.argv) > 2:
        print(kinds_table(sys.argv[1], sys.argv[2].split(",")))
    else:
        print(table(*sys.argv[1:2]))
