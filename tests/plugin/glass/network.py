# SPDX-License-Identifier: Apache-2.0
from torch import nn

from sphericalvision.cameras import CameraRig
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import DepthNetwork
from sphericalvision.sweep import SphereSweep, depth_estimate, sphere_sweep


class ColourVariance(DepthNetwork):
    """Depth where the cameras see the same colour, by a small function of the colours' variance."""

    def __init__(self, level=5, num_hypotheses=16, min_depth=0.55, width=8):
        super().__init__(num_hypotheses, min_depth, num_cameras=2, any_cameras=True)
        self.level, self.grid = level, Icosphere(level - 2)
        self.sweep = SphereSweep(level - 2, num_hypotheses, min_depth, feature_level=level)
        self.score = nn.Sequential(nn.Linear(3, width), nn.ReLU(), nn.Linear(width, 1))

    def tables(self, rig):
        return self.sweep.tables(rig)

    def predict(self, images, rig, seen=None):
        tables = self.tables(rig) if isinstance(rig, CameraRig) else rig
        colours, seen = sphere_sweep(images, tables, seen)  # (B, n, 3, N, V), (B, n, N, V)
        weights = seen[:, :, None] / seen[:, :, None].sum(1, keepdim=True).clamp(min=1)
        mean = (weights * colours).sum(1, keepdim=True)
        variance = (weights * (colours - mean) ** 2).sum(1)  # (B, 3, N, V)
        return depth_estimate(self.score(variance.movedim(1, -1))[..., 0], seen)
