# SPDX-License-Identifier: Apache-2.0
"""How wrong a method is on one frame: at vertices, on a panorama, in metres, by kind of place, by confidence."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, seen_by
from sphericalvision.icosphere import Icosphere, level_from_num_vertices
from sphericalvision.metrics import depth_error, depth_index_error
from sphericalvision.metrics.spread import error_of_surest
from sphericalvision.metrics.structure import depth_structure, local_contrast
from sphericalvision.models import DepthNetwork
from sphericalvision.recipes.study.benchmark.frames import Frame
from sphericalvision.recipes.study.benchmark.methods import HYPOTHESES, MIN_DEPTH, Said
from sphericalvision.sphere import Equirectangular
from sphericalvision.sweep import (
    depth_from_index,
    index_from_inverse_depth,
    inverse_depth_from_index,
)

__all__ = ["KEPT", "REGIONS", "FrameTruth", "score"]

REGIONS = ("all", "edge", "thin", "flat", "bare", "sky", "lone", "shared")
"""``all``: points that two cameras see; ``lone``: that fewer see; ``shared``: that two see at every tilt."""

KEPT = (1.0, 0.95, 0.9, 0.8, 0.7, 0.5)
"""Shares of the surest points."""

LEAST_CONTRAST = 0.01
"""Standard deviation of the brightness, of the range [0, 1], below which a surface is bare."""

Scores = dict[str, Any]


class FrameTruth:
    """What is right in a frame and where it counts, the same for all methods.

    Args:
        frame: as rendered.
    """

    def __init__(self, frame: Frame) -> None:
        self.fine = Icosphere(_level_of(frame))
        self.coarse_ids = coarse_ids(self.fine.level)
        self.index = index_from_inverse_depth(frame.inverse_depth, HYPOTHESES, MIN_DEPTH)
        self.valid = frame.inverse_depth <= 1 / MIN_DEPTH
        self.inverse_depth = frame.inverse_depth.where(self.valid, 0.0)
        vertices = self.fine.vertices
        shared = self.valid & _two_see(frame.free_rig, vertices, self.inverse_depth)
        structure = depth_structure(self.index)
        sky = frame.inverse_depth == 0
        bare = (local_contrast(frame.colors) < LEAST_CONTRAST) & ~structure.edge & ~sky
        at_all = shared.clone()
        for rig in frame.shared_rigs:
            at_all &= _two_see(rig, vertices, self.inverse_depth)
        self.regions = {
            "all": shared,
            "edge": shared & structure.edge,
            "thin": shared & structure.thin,
            "flat": shared & structure.flat & ~sky,
            "bare": shared & bare,
            "sky": shared & sky,
            "lone": self.valid & ~shared,
            "shared": at_all if frame.shared_rigs else torch.zeros_like(shared),
        }
        grid = Equirectangular(*frame.panorama.shape)
        self.around, self.solid_angles = grid.directions.reshape(-1, 3), grid.solid_angles.reshape(-1)
        flat = frame.panorama.reshape(-1)
        self.panorama = index_from_inverse_depth(flat, HYPOTHESES, MIN_DEPTH)
        known = flat <= 1 / MIN_DEPTH
        self.panorama_counts = known & _two_see(frame.free_rig, self.around, flat.where(known, 0.0))

    def index_of(self, net: DepthNetwork, index: Tensor) -> Tensor:
        """Index ``(V,)`` of the benchmark's hypotheses at the fine vertices, NaN where the network says nothing."""
        fine, known = _index_at(net, index, self.fine.vertices)
        return fine[0].where(known, math.nan)


def score(net: DepthNetwork, said: Said, truth: FrameTruth) -> Scores:
    """Scores of one frame: nested dictionaries of numbers, None where nothing counts.

    * ``coarse``, ``fine``: at level 4 and 6 (two below the truth's, and its), by region, percent of N = 16;
    * ``panorama``: the same, every pixel with its solid angle;
    * ``metres``: AbsRel and the share within a factor 1.25, at the coarse vertices;
    * ``kept``: MAE of the surest points, by share of them; empty for a method that is equally sure of all;
    * ``points``: percent of the fine vertices that each region has.
    """
    fine, known = _index_at(net, said.estimate.index, truth.fine.vertices)
    sure, _ = net.index_at(said.estimate.confidence.float(), truth.fine.vertices)
    coarse = truth.coarse_ids
    levels: Scores = {}
    for name, ids in (("coarse", coarse), ("fine", slice(None))):
        levels[name] = {
            region: _errors(fine[:, ids], truth.index[ids], (mask & known)[ids])
            for region, mask in truth.regions.items()
        }
    panorama, there = _index_at(net, said.estimate.index, truth.around)
    counts = truth.panorama_counts & there
    mask = (truth.regions["all"] & known)[coarse]
    depth = depth_from_index(fine[:, coarse], HYPOTHESES, MIN_DEPTH)
    metres = depth_error(depth, truth.inverse_depth[coarse].reciprocal()[None], mask[None])
    return {
        **levels,
        "panorama": _errors(panorama, truth.panorama, counts, truth.solid_angles.float()),
        "metres": {key: _plain(metres[key]) for key in ("AbsRel", "d<1.25")},
        "kept": _kept(fine[:, coarse], sure[:, coarse], truth.index[coarse], mask),
        "points": {region: 100 * mask.float().mean().item() for region, mask in truth.regions.items()},
    }


def coarse_ids(level: int) -> Tensor:
    """Numbers of the vertices that the icosphere two levels coarser has, too."""
    return _coarse_ids(level)


@lru_cache(maxsize=4)
def _coarse_ids(level: int) -> Tensor:
    return Icosphere(level).coarse_ids[Icosphere(level - 1).coarse_ids]


def _level_of(frame: Frame) -> int:
    return level_from_num_vertices(frame.inverse_depth.shape[-1])


def _two_see(rig: CameraRig, directions: Tensor, inverse_depth: Tensor) -> Tensor:
    return seen_by(rig, directions, inverse_depth) >= 2


def _index_at(net: DepthNetwork, index: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Index ``(1, V)`` in the benchmark's hypotheses, and where the network says anything ``(V,)``."""
    found, known = net.index_at(index.float(), directions)
    inverse_depth = inverse_depth_from_index(found, net.num_hypotheses, net.min_depth)
    return index_from_inverse_depth(inverse_depth, HYPOTHESES, MIN_DEPTH), known


def _errors(
    index: Tensor, truth: Tensor, mask: Tensor, weights: Tensor | None = None
) -> dict[str, float | None]:
    errors = depth_index_error(index, truth[None], HYPOTHESES, mask[None], weights)
    return {name: _plain(value) for name, value in errors.items()}


def _kept(index: Tensor, sure: Tensor, truth: Tensor, mask: Tensor) -> dict[str, float]:
    if not mask.any() or float(sure[:, mask].std()) < 1e-6:
        return {}
    error = (index - truth).abs() * (100 / HYPOTHESES)
    means = error_of_surest(error, sure, KEPT, mask[None])[0]
    return {f"{share:g}": value for share, value in zip(KEPT, means.tolist(), strict=True)}


def _plain(value: Tensor) -> float | None:
    number = float(value.reshape(()))
    return None if math.isnan(number) else number
