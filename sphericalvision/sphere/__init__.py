# SPDX-License-Identifier: Apache-2.0
"""Grids of directions and resampling between them and cameras."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
