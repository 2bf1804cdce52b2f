# SPDX-License-Identifier: Apache-2.0
"""Sphere sweeping: hypotheses of depth, the volume that cameras see at them, and the way back to a depth."""

from sphericalvision.sweep.aggregation import (
    Aggregation,
    Concatenation,
    MeanVariance,
    register_aggregation,
)
from sphericalvision.sweep.consistency_share import photo_consistency_share
from sphericalvision.sweep.correlation import correlation_evidence
from sphericalvision.sweep.hypotheses import (
    depth_from_index,
    index_from_depth,
    index_from_inverse_depth,
    inverse_depth_from_index,
    inverse_depth_hypotheses,
)
from sphericalvision.sweep.panorama_sweep import PanoramaSweep
from sphericalvision.sweep.photo_consistency import photo_consistency
from sphericalvision.sweep.regression import (
    DepthEstimate,
    depth_estimate,
    soft_argmax,
    soft_argmax_confidence,
)
from sphericalvision.sweep.semi_global import (
    semi_global_costs,
    semi_global_sweep,
    semi_global_tables,
)
from sphericalvision.sweep.smoothing import semi_global_smoothing
from sphericalvision.sweep.sphere_sweep import SphereSweep, SweepTables, SweepVolume, sphere_sweep

__all__ = [
    "Aggregation",
    "Concatenation",
    "DepthEstimate",
    "MeanVariance",
    "PanoramaSweep",
    "SphereSweep",
    "SweepTables",
    "SweepVolume",
    "correlation_evidence",
    "depth_estimate",
    "depth_from_index",
    "index_from_depth",
    "index_from_inverse_depth",
    "inverse_depth_from_index",
    "inverse_depth_hypotheses",
    "photo_consistency",
    "photo_consistency_share",
    "register_aggregation",
    "semi_global_costs",
    "semi_global_smoothing",
    "semi_global_sweep",
    "semi_global_tables",
    "soft_argmax",
    "soft_argmax_confidence",
    "sphere_sweep",
]
