# SPDX-License-Identifier: Apache-2.0
"""The icosphere: a nearly uniform grid of directions, its topology, its levels, and exact point location."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
