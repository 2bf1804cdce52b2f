# SPDX-License-Identifier: Apache-2.0
"""Error of panoramas near the edges of what is seen, and elsewhere: a table of the guide.

Run from the root of the repository: ``python docs/edges.py``, two minutes; ``python docs/edges.py 512 room,floating``
for images of 512 x 512 pixels and some kinds of scenes.
"""

from __future__ import annotations

import sys
from collections import defaultdict

import torch
import torch.nn.functional as F
from torch import Tensor

from sphericalvision.cameras import ring_rig
from sphericalvision.capture import Predictor
from sphericalvision.scenes import make_scene, ray_depth, render_rig
from sphericalvision.sphere import Equirectangular
from sphericalvision.sweep import index_from_inverse_depth

KINDS = "room,floating,hall,outdoors,patchwork,rough,glazed,ruins"
SEED = 2_900_000
HEIGHT, NUM_HYPOTHESES, MIN_DEPTH = 640, 16, 0.55
NETWORKS = (
    ("refinedsweepnet", 6),
    ("refinedsweepnet", 7),
    ("refinedsweepnet", 8),
)
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


def table(pixels: int = 1024, kinds: str = KINDS) -> str:
    """The lines of the table, as Markdown: means over one held-out scene of each kind, in hypotheses."""
    rig = ring_rig(4, image_size=(pixels, pixels))
    predictors = {
        f"`{name}`, level {level}": Predictor(
            rig, name, level=level, min_depth=MIN_DEPTH
        )
        for name, level in NETWORKS
    }
    rays = Equirectangular(HEIGHT, 2 * HEIGHT).directions.flatten(0, 1)
    errors = defaultdict(list)
    for kind in kinds.split(","):
        scene = make_scene(kind, SEED)
        images = render_rig(scene, rig)
        truth = index_of(ray_depth(scene, rig.center, rays).reciprocal()).view(
            HEIGHT, 2 * HEIGHT
        )
        near = near_edges(truth)
        for name, predictor in predictors.items():
            depth = predictor(images)
            panorama = depth.panorama(HEIGHT)
            off = (index_of(panorama.depth.reciprocal()) - truth).abs()
            errors[name].append(
                (
                    off[near & panorama.seen].mean(),
                    off[~near & panorama.seen].mean(),
                )
            )
    lines = ["| | near edges | elsewhere |", "|---|---:|---:|"]
    for row, found in errors.items():
        at_edges, elsewhere = torch.tensor(found).mean(0).tolist()
        lines.append(f"| {row} | {at_edges:.2f} | {elsewhere:.3f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    print(table(*map(int, sys.argv[1:2]), *sys.argv[2:3]))
