# SPDX-License-Identifier: Apache-2.0
"""Camera models that work on directions, beyond 180° where the lens does, rigs of them, and calibration files."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
