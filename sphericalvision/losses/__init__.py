# SPDX-License-Identifier: Apache-2.0
"""Losses on hypothesis indices, and losses on any grid weighted by solid angle."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
