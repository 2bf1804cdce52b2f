# SPDX-License-Identifier: Apache-2.0
"""Errors of hypothesis indices and depths, where they count, means over the sphere, and segmentation by area."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
