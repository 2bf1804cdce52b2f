# SPDX-License-Identifier: Apache-2.0
"""The measure of the comparison: errors at vertices, on a panorama, in metres, by kind of place, by confidence."""

from typing import Any

import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, seen_by
from sphericalvision.icosphere import Icosphere, level_from_num_vertices
from sphericalvision.metrics import depth_index_error
from sphericalvision.metrics.spread import error_of_surest
from sphericalvision.metrics.structure import depth_structure, local_contrast
from sphericalvision.recipes.evaluation.loop import Limit, errors_in_metres
from sphericalvision.recipes.evaluation.methods import SCALE, Answer
from sphericalvision.recipes.evaluation.track_frames import TrackFrame
from sphericalvision.sphere import Equirectangular
from sphericalvision.sweep import depth_from_index, index_from_inverse_depth
from sphericalvision.sweep.ring_mean import ids_of_coarser_level

REGIONS = ("all", "edge", "thin", "flat", "bare", "sky", "lone", "shared")
"""``all``: points that two cameras see; ``lone``: that fewer see; ``shared``: that two see at every tilt."""

KEPT = (1.0, 0.95, 0.9, 0.8, 0.7, 0.5)
"""Fractions of the points, the surest first."""

LEAST_CONTRAST = 0.01
"""Standard deviation of the brightness, of the range [0, 1], below which a surface is bare."""


class FrameTruth:
    """Truth of a rendered frame and where it counts, the same for all methods."""

    def __init__(self, frame: TrackFrame) -> None:
        self.name, self.fine = frame.name, Icosphere(level_from_num_vertices(frame.inverse_depth.shape[-1]))
        self.coarse_ids = ids_of_coarser_level(self.fine.level, self.fine.level - 2)
        self.index = index_from_inverse_depth(frame.inverse_depth, *SCALE)
        self.valid = frame.inverse_depth <= 1 / SCALE.min_depth
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
        self.panorama = index_from_inverse_depth(flat, *SCALE)
        valid = flat <= 1 / SCALE.min_depth
        self.panorama_counts = valid & _two_see(frame.free_rig, self.around, flat.where(valid, 0.0))


class PlaceErrors:
    """Errors of single frames.

    * ``coarse``, ``fine``: at level 4 and 6 (two below the truth's, and its), by region, percent of N = 16;
    * ``panorama``: the same, every pixel with its solid angle;
    * ``metres``: of ``errors_in_metres``, at the coarse vertices;
    * ``kept``: MAE of the surest points, by their fraction; empty for a method that is equally sure of all;
    * ``points``: percent of the fine vertices that each region has.

    Args:
        level: icosphere on which truth is dense.
        max_depth: of errors in metres.
    """

    scale = SCALE

    def __init__(self, level: int, max_depth: Limit = "auto") -> None:
        self.directions, self.max_depth = Icosphere(level).vertices, max_depth
        self.key = {"generation": 3, "max_depth": max_depth}

    def truth(self, frame: TrackFrame) -> FrameTruth:
        """Truth of a frame."""
        return FrameTruth(frame)

    def errors(self, answer: Answer, truth: FrameTruth) -> dict[str, Any]:
        """Errors of the frame, tensors ``(1,)``."""
        (fine, valid), coarse = answer.index_at(self.directions, SCALE), truth.coarse_ids
        levels = {
            name: {
                region: _errors(fine[:, ids], truth.index[ids], (mask & valid)[:, ids])
                for region, mask in truth.regions.items()
            }
            for name, ids in (("coarse", coarse), ("fine", slice(None)))
        }
        panorama, panorama_valid = answer.index_at(truth.around, SCALE)
        mask = (truth.regions["all"] & valid)[:, coarse]
        depth, target = depth_from_index(fine[:, coarse], *SCALE), truth.inverse_depth[coarse].reciprocal()
        solid_angles = truth.solid_angles.float()
        return {
            **levels,
            "panorama": _errors(
                panorama, truth.panorama, truth.panorama_counts & panorama_valid, solid_angles
            ),
            "metres": errors_in_metres(depth, target[None], mask, [truth.name], self.max_depth),
            "kept": _errors_of_surest(
                fine[:, coarse],
                answer.confidence_at(self.directions)[:, coarse],
                truth.index[coarse],
                mask,
            ),
            "points": {region: 100 * mask.float().mean()[None] for region, mask in truth.regions.items()},
        }


def _two_see(rig: CameraRig, directions: Tensor, inverse_depth: Tensor) -> Tensor:
    return seen_by(rig, directions, inverse_depth) >= 2


def _errors(index: Tensor, truth: Tensor, mask: Tensor, weights: Tensor | None = None) -> dict[str, Tensor]:
    return depth_index_error(index, truth[None], SCALE.num_hypotheses, mask, weights)


def _errors_of_surest(index: Tensor, confidence: Tensor, truth: Tensor, mask: Tensor) -> dict[str, Tensor]:
    if not mask.any() or float(confidence[mask].std()) < 1e-6:
        return {}
    error = (index - truth).abs() * (100 / SCALE.num_hypotheses)
    means = error_of_surest(error, confidence, KEPT, mask)
    return {f"{fraction:g}": means[:, column] for column, fraction in enumerate(KEPT)}
