# SPDX-License-Identifier: Apache-2.0
"""Procedural scenes: a seed makes a scene of primitives, materials and lamps."""
