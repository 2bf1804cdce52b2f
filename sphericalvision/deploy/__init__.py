# SPDX-License-Identifier: Apache-2.0
"""The old name of ``sphericalvision.capture``."""

from sphericalvision.capture import Depth, DepthImage, Predictor

__all__ = ["Depth", "DepthImage", "Predictor"]
