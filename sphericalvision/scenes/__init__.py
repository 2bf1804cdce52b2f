# SPDX-License-Identifier: Apache-2.0
"""Worlds to train and to test in: scenes from seeds, what carries a rig through them, exact images and depth."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
