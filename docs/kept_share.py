# SPDX-License-Identifier: Apache-2.0
"""Error of the semi-global sweep against the share of points that is kept by confidence: the table of the guide.

Run as ``python docs/kept_share.py``, from the root of the repository; it takes half a minute.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sphericalvision.cameras import ring_rig
from sphericalvision.data import SceneDataset
from sphericalvision.sweep import index_from_inverse_depth, semi_global_sweep

NUM_HYPOTHESES, MIN_DEPTH = 16, 0.55
SHARES = (1.0, 0.9, 0.8, 0.5)


def measured(tilt_deg: float, num_scenes: int, level: int = 6) -> tuple[Tensor, Tensor]:
    """Errors and confidences ``(P,)`` at all points of held-out scenes that two cameras see."""
    rig = ring_rig(4, 0.2, (256, 256)).rotated(tilt=math.radians(tilt_deg))
    scenes = SceneDataset(num_scenes, rig, level, "mixed", 2_000_000, samples_per_pixel=2, antialias=True)
    errors, confidences = [], []
    for sample in (scenes[number] for number in range(num_scenes)):
        found = semi_global_sweep(
            sample["images"][None], rig, NUM_HYPOTHESES, MIN_DEPTH, seen=sample["seen"][None]
        )
        truth = index_from_inverse_depth(sample["inverse_depth"], NUM_HYPOTHESES, MIN_DEPTH)
        counts = sample["valid"] & found.seen[0]
        errors.append((found.index[0] - truth).abs()[counts])
        confidences.append(found.confidence[0, counts])
    return torch.cat(errors), torch.cat(confidences)


def table(num_scenes: int = 12) -> str:
    """The lines of both tables, as Markdown."""
    errors, confidences = map(torch.cat, zip(*(measured(tilt, num_scenes) for tilt in (0, 30)), strict=True))
    order = confidences.argsort(descending=True)
    lines = ["| kept | confidence from | mean error, % of N | error below 1 |", "|---:|---:|---:|---:|"]
    for share in SHARES:
        kept = order[: round(share * len(order))]
        mean, below = 100 / NUM_HYPOTHESES * errors[kept].mean(), (errors[kept] < 1).float().mean()
        lines.append(f"| {share:.0%} | {confidences[kept[-1]]:.2f} | {mean:.2f} | {below:.1%} |")
    lines += ["", "| confidence | points | error below 1 |", "|---|---:|---:|"]
    for low in (0.0, 0.2, 0.4, 0.6, 0.8, 0.9):
        high = 1.01 if low == 0.9 else 0.9 if low == 0.8 else low + 0.2
        inside = (confidences >= low) & (confidences < high)
        below, said = (errors[inside] < 1).float().mean(), confidences[inside].mean()
        points = inside.float().mean()
        lines.append(f"| {low:.1f} to {min(high, 1):.1f} | {points:.0%} | {below:.0%} (said {said:.0%}) |")
    return "\n".join(lines)


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    print(table())
