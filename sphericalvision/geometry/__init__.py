# SPDX-License-Identifier: Apache-2.0
"""Pure functions: directions, rigid transforms and interpolation.

Numerics that cameras and grids are made of are in the modules: ``directions``, ``rootfinding``,
``lookup``, ``least_squares``.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
