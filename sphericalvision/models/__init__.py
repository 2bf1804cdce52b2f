# SPDX-License-Identifier: Apache-2.0
"""Networks, composed of the rooms below, and their weights."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
