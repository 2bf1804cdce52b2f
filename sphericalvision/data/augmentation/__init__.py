# SPDX-License-Identifier: Apache-2.0
"""Transforms of samples, and augmentation by rotation and by light."""
