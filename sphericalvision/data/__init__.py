# SPDX-License-Identifier: Apache-2.0
"""Scenes that are rendered, data sets on disk, and transforms of their samples."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
