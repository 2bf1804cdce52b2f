# SPDX-License-Identifier: Apache-2.0
"""Error against the share of points that is kept by confidence, one threshold for all scenes: the tables of the guide.

Run from the root of the repository: ``python docs/kept_share.py`` for the semi-global sweep, half a minute;
``python docs/kept_share.py refinedsweepnet`` for a network that ships, a minute.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.icosphere import Icosphere, level_from_num_vertices
from sphericalvision.models import DepthNetwork, pretrained
from sphericalvision.scenes import SceneDataset
from sphericalvision.sweep import index_from_inverse_depth, semi_global_sweep

NUM_HYPOTHESES, MIN_DEPTH = 16, 0.55
SHARES = (1.0, 0.9, 0.8, 0.5)
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
        found = net.predict(sample["images"][None], net.tables(rig), sample["seen"][None])
        vertices = Icosphere(level_from_num_vertices(len(sample["valid"]))).vertices
        index, confidence, seen = (net.index_at(values.float(), vertices)[0][0] for values in found)
        return Estimate(index, confidence, seen > 0.5)

    return estimate


def measured(method: Method, tilt_deg: float, num_scenes: int, level: int = 6) -> Answers:
    """Answers at all points of held-out scenes that two cameras see."""
    rig = ring_rig(4, 0.2, (256, 256)).rotated(tilt=math.radians(tilt_deg))
    scenes = SceneDataset(num_scenes, rig, level, "mixed", 2_000_000, samples_per_pixel=2, antialias=True)
    errors, confidences = [], []
    for sample in (scenes[number] for number in range(num_scenes)):
        found = method(sample, rig)
        truth = index_from_inverse_depth(sample["inverse_depth"], NUM_HYPOTHESES, MIN_DEPTH)
        counts = sample["valid"] & found.seen
        errors.append((found.index - truth).abs()[counts])
        confidences.append(found.confidence[counts])
    return Answers(torch.cat(errors), torch.cat(confidences))


def kept_table(answers: Answers) -> list[str]:
    """Errors of the surest points."""
    order = answers.confidences.argsort(descending=True)
    lines = ["| kept | confidence from | mean error, % of N | error below 1 |", "|---:|---:|---:|---:|"]
    for share in SHARES:
        kept = order[: round(share * len(order))]
        errors = answers.errors[kept]
        mean, below = 100 / NUM_HYPOTHESES * errors.mean(), (errors < 1).float().mean()
        lines.append(f"| {share:.0%} | {answers.confidences[kept[-1]]:.2f} | {mean:.2f} | {below:.1%} |")
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
            lines.append(f"{share} {(errors < 1).float().mean():.0%} (said {said:.0%}) |")
        else:
            lines.append(f"{share} {errors.clamp(max=2).mean():.2f} (said {2 - 2 * said:.2f}) |")
    return lines


def table(name: str | None = None, num_scenes: int = 12) -> str:
    """The lines of both tables, as Markdown."""
    method = by_sweep if name is None else by_network(pretrained(name))
    level_and_tilted = [measured(method, tilt, num_scenes) for tilt in (0, 30)]
    answers = Answers(*map(torch.cat, zip(*level_and_tilted, strict=True)))
    return "\n".join([*kept_table(answers), "", *said_table(answers, is_probability=name is None)])


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    print(table(*sys.argv[1:2]))
