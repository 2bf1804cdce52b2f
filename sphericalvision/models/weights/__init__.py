# SPDX-License-Identifier: Apache-2.0
"""Weights on disk: safetensors with hyper-parameters inside, the authors' checkpoints, shipped ones."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
