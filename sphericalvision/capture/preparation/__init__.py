# SPDX-License-Identifier: Apache-2.0
"""Preprocessing of a capture: own body, noise, light, orientations, nearest depth."""
