# SPDX-License-Identifier: Apache-2.0
"""The crown: an icosphere laid out as ten rectangles, and the layers that work on it or on the vertices directly."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
