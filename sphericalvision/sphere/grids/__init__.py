# SPDX-License-Identifier: Apache-2.0
"""Grids of directions: panoramas, cube maps, HEALPix, tangent images."""
