# SPDX-License-Identifier: Apache-2.0
"""What exists for speed alone; the rest of ``sphere`` enters by ``door`` and works without."""
