# SPDX-License-Identifier: Apache-2.0
"""What confidences are worth: ``docs/data/reliability.json``, and ``sweep.json`` of the sweep without training.

Run from the root of the repository: ``python docs/confidence.py``, four minutes.
"""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from edges import MIN_DEPTH, NUM_HYPOTHESES
from figures.tables import write
from sphericalvision.cameras import ring_rig
from sphericalvision.capture import Predictor
from sphericalvision.metrics.spread import error_of_surest
from sphericalvision.recipes.evaluation.tables import Row, Table
from sphericalvision.scenes import make_scene, ray_depth, render_rig
from sphericalvision.sweep import index_from_inverse_depth

FILE = Path(__file__).parent / "data" / "reliability.json"
KINDS = (
    *("room", "hall", "floating", "outdoors", "patchwork", "rough"),
    *("glazed", "terrain", "ruins", "plain", "lit"),
)
SEEDS = range(2_900_000, 2_900_004)
BOUNDS = (0, 0.2, 0.4, 0.6, 0.8, 0.9, 1)
FEWEST = 200
"""Points, of fewer of which no mean is given."""


def measured(predictor: Predictor, kind: str) -> tuple[Tensor, Tensor]:
    """Error in hypotheses and confidence where two cameras see, of all scenes of a kind."""
    errors, confidences = [], []
    for seed in SEEDS:
        scene = make_scene(kind, seed)
        depth = predictor(render_rig(scene, predictor.rig, 1))
        truth = 1 / ray_depth(scene, predictor.rig.center, depth.directions)
        index, true_index = (
            index_from_inverse_depth(values, NUM_HYPOTHESES, MIN_DEPTH)
            for values in (depth.inverse_depth, truth)
        )
        mask = depth.seen & (truth <= 1 / MIN_DEPTH)
        errors.append((index - true_index).abs()[mask])
        confidences.append(depth.confidence[mask])
    return torch.cat(errors), torch.cat(confidences)


def bins(confidence: Tensor) -> list[Tensor]:
    """Which points are in each range of confidence."""
    return [
        (low < confidence) & (confidence <= high) for low, high in pairwise(BOUNDS)
    ]


def reliability(predictor: Predictor) -> dict[str, dict[str, object]]:
    """Of each kind: mean error in percent of N, that of the surest, and errors as they are and as they are expected."""
    kinds = {}
    for kind in KINDS:
        error, confidence = measured(predictor, kind)
        shares = error_of_surest(error[None], confidence[None], (0.8, 1.0))
        surest, mean = shares[0].tolist()
        pairs = [
            [round(float(x[mask].mean()), 2) for x in (error, 2 * (1 - confidence))]
            if mask.sum() >= FEWEST
            else None
            for mask in bins(confidence)
        ]
        kinds[kind] = {
            "mean": round(100 * mean / NUM_HYPOTHESES, 2),
            "surest": round(surest / mean, 2),
            "errors": pairs,
        }
    return kinds


def of_sweep(predictor: Predictor) -> Table:
    """Share of points, and of those with an error below one hypothesis, by confidence."""
    pairs = [measured(predictor, kind) for kind in ("room", "floating")]
    error, confidence = (torch.cat(values) for values in zip(*pairs, strict=True))
    rows: list[Row] = []
    for (low, high), mask in zip(pairwise(BOUNDS), bins(confidence), strict=True):
        right, said = (error[mask] < 1).float().mean(), confidence[mask].mean()
        points, right = (
            f"{mask.float().mean():.0%}",
            f"{right:.0%} (said {said:.0%})",
        )
        rows.append([f"{low:.1f} to {high:.1f}", points, right])
    return Table("", ("confidence", "points", "error below 1"), rows)


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    rig = ring_rig(4, image_size=(256, 256))
    sweep = Predictor(rig, method="semi_global", min_depth=MIN_DEPTH)
    write("sweep", {"confidence": of_sweep(sweep)})
    kinds = reliability(Predictor(rig, min_depth=MIN_DEPTH))
    rows = (f' "{kind}": {json.dumps(row)}' for kind, row in kinds.items())
    FILE.write_text("{\n" + ",\n".join(rows) + "\n}\n")
