# SPDX-License-Identifier: Apache-2.0
"""The old name of ``sphericalvision.capture.sources.videos``."""

from sphericalvision.capture.sources.videos import Videos

__all__ = ["Videos"]
