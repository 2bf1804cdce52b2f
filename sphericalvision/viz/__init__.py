# SPDX-License-Identifier: Apache-2.0
"""Pictures, point clouds and meshes of depth, errors, cameras and rigs."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
