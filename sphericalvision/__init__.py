# SPDX-License-Identifier: Apache-2.0
"""Spherical vision for PyTorch: wide cameras, icospheres, crown convolutions and sphere sweeps."""

__version__ = "0.1.0"
