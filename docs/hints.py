# SPDX-License-Identifier: Apache-2.0
"""What a hint is worth, what a wrong one costs, and how steady the last frame makes the next: ``docs/data/hints.json``.

Run from the root of the repository: ``python docs/hints.py``, a few minutes;
``python docs/hints.py some.safetensors`` for other weights.
"""

from __future__ import annotations

import sys
import warnings
from collections import defaultdict
from collections.abc import Iterator

import torch
from torch import Tensor

from edges import MIN_DEPTH, index_of
from figures.tables import write
from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import Depth, Hint, Predictor
from sphericalvision.icosphere import (
    Icosphere,
    icosphere_upsample,
    num_icosphere_vertices,
)
from sphericalvision.recipes.evaluation.tables import Row, Table
from sphericalvision.scenes import World, make_scene, ray_depth, render_rig
from sphericalvision.sweep import DepthHint
from sphericalvision.sweep.visibility import seen_in_view

KINDS, SEEDS = ("plain", "polished", "room"), (2_900_000, 2_900_001)
LEVEL, PIXELS = 6, 240
NARROW = 2.0
"""Field of view, radians, of which four around see two thirds of the directions alone."""
FRAMES, STEP, NOISE = 8, 0.05, 0.03
"""Of a drive: images, metres between them, and the deviation of their noise."""
STATIC = 0.1
"""Hypotheses: deviation over time of the truth, below which a direction is static."""


def noise(level: int, relative: float, generator: torch.Generator) -> Tensor:
    """Factors ``(1, V)`` of this mean relative error, for a half alike over 20 degrees and for a half independent."""
    smooth = torch.randn(1, 1, num_icosphere_vertices(2), generator=generator)
    for _ in range(2, level):
        smooth = icosphere_upsample(smooth)
    smooth = smooth[:, 0] / smooth.std()
    independent = torch.randn(smooth.shape, generator=generator)
    return (
        relative * 1.25 * (0.7 * smooth + 0.7 * independent)
    ).exp()  # 1.25 deviations are one mean


def hints(
    truth: Tensor, other: Tensor, level: int
) -> Iterator[tuple[str, DepthHint | None]]:
    """Row of the table and hint, on a network's vertices, of the true inverse depth ``(1, V)`` or another."""
    generator, every = torch.Generator().manual_seed(0), torch.ones_like(truth)
    yield "none", None
    yield "of weight 0", DepthHint(truth, 0 * every)
    yield "5 % off", DepthHint(truth * noise(level, 0.05, generator), every)
    yield (
        "10 % off, weight 0.5",
        DepthHint(truth * noise(level, 0.1, generator), every / 2),
    )
    points = (torch.rand(truth.shape, generator=generator) < 0.02).float()
    yield (
        "one direction in fifty, 1 % off",
        DepthHint(truth * noise(level, 0.01, generator), points),
    )
    yield "of another scene", DepthHint(other, every)
    yield "half as far away", DepthHint(2 * truth, every)
    grid = Icosphere(level)
    turned = grid.nearest(
        grid.vertices[:, [2, 1, 0]] * grid.vertices.new_tensor([1, 1, -1])
    )
    yield "turned by 90 degrees", DepthHint(truth[:, turned], every)
    yield (
        "random, smooth",
        DepthHint(truth.median() * noise(level, 0.7, generator), every),
    )


def of_hints(weights: str) -> Table:
    """Mean error in hypotheses of what two cameras see, and of what one of narrow cameras sees alone."""
    errors = defaultdict(list)
    for field_of_view in (None, NARROW):
        rig = ring_rig(4, image_size=(PIXELS, PIXELS))
        if field_of_view is not None:
            rig = ring_rig(
                4, image_size=(PIXELS, PIXELS), field_of_view=field_of_view
            )
        predictor = Predictor(rig, weights, level=LEVEL, min_depth=MIN_DEPTH)
        views = seen_in_view(predictor.rig, LEVEL).sum(0)
        directions = predictor.network.grid.directions
        for kind in KINDS:
            scenes = [make_scene(kind, seed) for seed in SEEDS]
            truths = [
                ray_depth(scene, rig.center, directions).reciprocal()[None]
                for scene in scenes
            ]
            for scene, truth, other in zip(
                scenes, truths, truths[::-1], strict=True
            ):
                images = render_rig(scene, rig, 1)
                near = truth[0] > 1 / MIN_DEPTH
                for row, hint in hints(truth, other, LEVEL):
                    answers = {row: predictor(images, hint).inverse_depth}
                    if hint is not None and row == "5 % off":
                        answers["the same hint alone"] = hint.inverse_depth[0]
                    for name, answer in answers.items():
                        off = (index_of(answer) - index_of(truth[0])).abs()
                        if field_of_view is None:
                            errors[name, kind].append(
                                off[(views >= 2) & ~near].mean()
                            )
                        else:
                            errors[name, "one camera"].append(
                                off[(views == 1) & ~near].mean()
                            )
    columns = (*KINDS, "one camera")
    rows: list[Row] = []
    base = {
        column: float(torch.stack(errors["none", column]).mean())
        for column in columns
    }
    for row in dict.fromkeys(row for row, _ in errors):
        means = {
            column: float(torch.stack(errors[row, column]).mean())
            for column in columns
        }
        cells = [
            f"{means[column]:.2f} ({100 * (means[column] / base[column] - 1):+.0f} %)"
            for column in columns
        ]
        rows.append([row, *cells])
    return Table("", ("hint", *columns), rows)


def drive(
    scene: World, rig: CameraRig
) -> Iterator[tuple[CameraRig, dict[str, Tensor]]]:
    """Rig and noisy images of frame after frame of a rig that goes straight ahead."""
    generator = torch.Generator().manual_seed(0)
    for frame in range(FRAMES):
        poses = rig.world_from_camera.clone()
        poses[:, 2, 3] += STEP * frame
        moved = rig.replaced(world_from_camera=poses)
        images = render_rig(scene, moved, 1)
        yield (
            moved,
            {
                name: (
                    image + NOISE * torch.randn(image.shape, generator=generator)
                ).clamp(0, 1)
                for name, image in images.items()
            },
        )


def of_drive(predictor: Predictor, scene: World) -> list[list[float]]:
    """Flicker and error of each frame for itself, and with the frame before."""
    off: dict[bool, list[Tensor]] = {False: [], True: []}
    truths = []
    last: Depth | None = None
    for moved, images in drive(scene, predictor.rig):
        at = predictor.with_changes(moved)
        truth = index_of(
            ray_depth(scene, moved.center, at.network.grid.directions).reciprocal()
        )
        truths.append(truth)
        off[False].append(index_of(at(images).inverse_depth) - truth)
        now = at(images)
        last = (
            now if last is None else Hint.of_depth(last, torch.eye(4)).averaged(now)
        )
        off[True].append(index_of(last.inverse_depth) - truth)
    stacks = [torch.stack(off[carried])[2:] for carried in (False, True)]
    static = torch.stack(truths)[2:].std(0) < STATIC
    return [
        [float(stack.std(0)[static].mean()) for stack in stacks],
        [float(stack.abs().mean()) for stack in stacks],
    ]


def of_drives(weights: str) -> Table:
    """Flicker, the deviation over time of static directions, and the mean error of all, in hypotheses."""
    rows: list[Row] = []
    for kind in KINDS:
        rig = ring_rig(4, image_size=(PIXELS, PIXELS))
        predictor = Predictor(rig, weights, level=LEVEL, min_depth=MIN_DEPTH)
        drives = [of_drive(predictor, make_scene(kind, seed)) for seed in SEEDS]
        flicker, error = torch.tensor(drives).mean(0).tolist()
        rows.append(
            [
                kind,
                f"{flicker[0]:.3f}",
                f"{flicker[1]:.3f} ({100 * (flicker[1] / flicker[0] - 1):+.0f} %)",
                f"{error[0]:.2f}",
                f"{error[1]:.2f} ({100 * (error[1] / error[0] - 1):+.0f} %)",
            ]
        )
    average = "with the last frame"
    return Table("", ("scene", "flicker", average, "error", average), rows)


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    warnings.simplefilter("ignore")  # hints of another scene are told
    weights = sys.argv[1] if len(sys.argv) > 1 else "refinedsweepnet"
    write("hints", {"drives": of_drives(weights), "hints": of_hints(weights)})
