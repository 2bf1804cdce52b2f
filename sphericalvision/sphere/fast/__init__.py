# SPDX-License-Identifier: Apache-2.0
"""What exists for speed alone; the rest of ``sphere`` enters by ``door`` and works without."""

from sphericalvision.sphere.fast.door import conv_in_rows, read_pixels

__all__ = ["conv_in_rows", "read_pixels"]
