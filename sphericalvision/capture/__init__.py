# SPDX-License-Identifier: Apache-2.0
"""From the photographs of a rig to depth: how a capture is prepared and calibrated, and a network and a rig in one."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
