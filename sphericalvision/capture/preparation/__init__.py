# SPDX-License-Identifier: Apache-2.0
"""How a capture is made ready: own body, noise, light, orientations, nearest depth."""
