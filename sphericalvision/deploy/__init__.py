# SPDX-License-Identifier: Apache-2.0
"""A network and a rig as one thing to call, and what becomes of its answers outside of training."""

from sphericalvision.deploy.depth import Depth, DepthImage
from sphericalvision.deploy.predictor import Predictor

__all__ = ["Depth", "DepthImage", "Predictor"]
