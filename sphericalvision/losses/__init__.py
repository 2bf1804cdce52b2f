# SPDX-License-Identifier: Apache-2.0
"""Losses on hypothesis indices, and losses on any grid weighted by solid angle."""

from sphericalvision.losses.depth import depth_index_huber, solid_angle_cross_entropy, solid_angle_mean

__all__ = ["depth_index_huber", "solid_angle_cross_entropy", "solid_angle_mean"]
