# SPDX-License-Identifier: Apache-2.0
"""What a new network and a new rig need before the first frame, and the cost volume, made in the obvious way.

Charts are written out place by place in Python loops; points of the sphere sweep are located by a search tree that
finds the three nearest vertices, as in the published code. For one point in eight these are not the corners of the
triangle that contains it.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.icosphere import icosphere_vertices, num_icosphere_vertices
from sphericalvision.sweep import SweepTables, inverse_depth_hypotheses

__all__ = ["plain_charts", "plain_setup", "plain_sweep_tables", "plain_volume"]


def plain_setup(
    rig: CameraRig, level: int, num_hypotheses: int, min_depth: float = 0.55
) -> tuple[dict[int, tuple[Tensor, Tensor]], SweepTables]:
    """Charts of the three levels that the network works on, and the tables of its sweep."""
    charts = {fine: plain_charts(fine) for fine in range(level - 2, level + 1)}
    return charts, plain_sweep_tables(rig, level - 2, num_hypotheses, min_depth)


def plain_charts(level: int) -> tuple[Tensor, Tensor]:
    """Vertex of every place of the crown: ``col`` ``(5, 2n + 1, n + 1)`` and ``row`` ``(5, n + 1, 2n + 1)``.

    Examples:
        >>> plain_charts(0)[0][0].tolist()
        [[0, 3], [1, 4], [2, 11]]
    """
    n = 2**level
    col = [[[_vertex(k, i, j, n) for j in range(n + 1)] for i in range(2 * n + 1)] for k in range(5)]
    row = []
    for k in range(5):
        following = col[(k + 1) % 5]
        row.append([col[k][i] + [following[n + i][j] for j in range(1, n + 1)] for i in range(n + 1)])
    return torch.tensor(col), torch.tensor(row)


def _vertex(chart: int, row: int, column: int, n: int) -> int:
    if row == 0 and column == 0:
        return 0
    if row == 2 * n and column == n:
        return 1 + 10 * n * n
    if row == 0:
        return _vertex((chart + 1) % 5, column, 0, n)
    if column == n:
        following = (chart + 1) % 5
        return _vertex(following, row + n, 0, n) if row <= n else _vertex(following, 2 * n, row - n, n)
    return 1 + (chart * 2 * n + row - 1) * n + column


def plain_volume(features: Tensor, tables: SweepTables) -> Tensor:
    """The concatenated cost volume ``(B, n * C, N, V)`` of features ``(B, n, C, V)``: a look-up for each."""
    cameras = []
    for camera in range(features.shape[1]):
        depths = []
        for depth in range(tables.ids.shape[-4]):
            ids, weights = tables.ids[depth, :, camera], tables.weights[depth, :, camera]
            corners = [features[:, camera][:, :, ids[:, k]] * weights[:, k] for k in range(3)]
            depths.append(corners[0] + corners[1] + corners[2])
        cameras.append(torch.stack(depths, 2))
    return torch.cat(cameras, 1)


def plain_sweep_tables(
    rig: CameraRig, level: int, num_hypotheses: int, min_depth: float = 0.55
) -> SweepTables:
    """Tables of a sphere sweep: camera by camera, hypothesis by hypothesis."""
    from scipy.spatial import cKDTree  # a dependency of scikit-image

    vertices = icosphere_vertices(level, torch.float64).numpy()
    tree = cKDTree(vertices)
    shape = (num_hypotheses, num_icosphere_vertices(level), len(rig))
    ids, weights = np.zeros((*shape, 3), dtype=np.int64), np.zeros((*shape, 3), dtype=np.float32)
    mask = np.zeros(shape, dtype=bool)
    poses, center = rig.world_from_camera.double().numpy(), rig.center.double().numpy()
    angles = rig.max_angles.double().numpy()
    for camera in range(len(rig)):
        for index, inverse_depth in enumerate(inverse_depth_hypotheses(num_hypotheses, min_depth).tolist()):
            rays = vertices + inverse_depth * (center - poses[camera, :3, 3])
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            seen = np.arccos(np.clip(rays @ poses[camera, :3, 2], -1, 1)) <= angles[camera]
            nearest = tree.query(rays[seen], k=3)[1]
            a, b, c = vertices[nearest].transpose(1, 0, 2)
            opposite = (np.cross(b, c), np.cross(c, a), np.cross(a, b))
            shares = np.abs(np.stack([(rays[seen] * normal).sum(1) for normal in opposite], 1))
            shares[:, 0] += 1e-12  # a vertex between two others is its own triangle
            ids[index, seen, camera] = nearest
            weights[index, seen, camera] = shares / shares.sum(1, keepdims=True)
            mask[index, :, camera] = seen
    return SweepTables(torch.from_numpy(ids), torch.from_numpy(weights), torch.from_numpy(mask))
