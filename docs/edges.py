# SPDX-License-Identifier: Apache-2.0
"""Error of panoramas near the edges of what is seen, and elsewhere: ``docs/data/edges.json``.

Run from the root of the repository: ``python docs/edges.py``, two minutes;
``python docs/edges.py some.safetensors`` for other weights.
"""

from __future__ import annotations

import sys
from collections import defaultdict

import torch
import torch.nn.functional as F
from torch import Tensor

from figures.tables import write
from sphericalvision.cameras import ring_rig
from sphericalvision.capture import Predictor
from sphericalvision.recipes.evaluation.tables import Cell, Row, Table
from sphericalvision.scenes import make_scene, ray_depth, render_rig
from sphericalvision.sphere import Equirectangular
from sphericalvision.sweep import index_from_inverse_depth

KINDS = (
    *("room", "floating", "hall", "outdoors"),
    *("patchwork", "rough", "glazed", "ruins"),
)
SEED = 2_900_000
PIXELS, HEIGHT, NUM_HYPOTHESES, MIN_DEPTH = 1024, 640, 16, 0.55
LEVELS = (6, 7, 8)
NEAR = 4
"""Pixels from an edge, at which neighbouring pixels differ by more than one hypothesis."""


def index_of(inverse_depth: Tensor) -> Tensor:
    """Index of what is no nearer than the nearest hypothesis."""
    return index_from_inverse_depth(inverse_depth, NUM_HYPOTHESES, MIN_DEPTH).clamp(
        0, NUM_HYPOTHESES - 1
    )


def near_edges(truth: Tensor) -> Tensor:
    """Where a panorama ``(h, w)`` of indices has an edge close by."""
    values = truth[None, None]
    jumps = F.max_pool2d(values, 3, 1, 1) + F.max_pool2d(-values, 3, 1, 1) > 1
    return F.max_pool2d(jumps.float(), 2 * NEAR + 1, 1, NEAR)[0, 0] > 0


def table(weights: str) -> Table:
    """Means over one held-out scene of each kind, in hypotheses."""
    rig = ring_rig(4, image_size=(PIXELS, PIXELS))
    predictors = {
        level: Predictor(rig, weights, level=level, min_depth=MIN_DEPTH)
        for level in LEVELS
    }
    rays = Equirectangular(HEIGHT, 2 * HEIGHT).directions.flatten(0, 1)
    errors = defaultdict(list)
    for kind in KINDS:
        scene = make_scene(kind, SEED)
        images = render_rig(scene, rig)
        truth = index_of(ray_depth(scene, rig.center, rays).reciprocal()).view(
            HEIGHT, 2 * HEIGHT
        )
        near = near_edges(truth)
        for level, predictor in predictors.items():
            panorama = predictor(images).panorama(HEIGHT)
            off = (index_of(panorama.depth.reciprocal()) - truth).abs()
            errors[level].append(
                (
                    off[near & panorama.seen].mean(),
                    off[~near & panorama.seen].mean(),
                )
            )
    rows: list[Row] = []
    for level, found in errors.items():
        at_edges, elsewhere = torch.tensor(found).mean(0).tolist()
        rows.append([str(level), Cell(at_edges), Cell(elsewhere, digits=3)])
    return Table("", ("level", "near edges", "elsewhere"), rows)


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    write("edges", {"edges": table(*sys.argv[1:] or ["refinedsweepnet"])})
