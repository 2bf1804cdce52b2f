# SPDX-License-Identifier: Apache-2.0
"""Semantic segmentation of rendered rooms, the whole sphere at a time: ``experiment=segmentation``."""
