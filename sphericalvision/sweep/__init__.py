# SPDX-License-Identifier: Apache-2.0
"""Sphere sweeping: hypotheses of depth, the volume that cameras see at them, and the way back to a depth."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
