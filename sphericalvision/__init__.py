# SPDX-License-Identifier: Apache-2.0
"""Spherical vision for PyTorch: wide cameras, icospheres, crown convolutions and sphere sweeps."""

from lazy_loader import attach_stub

__version__ = "0.2.0"

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
