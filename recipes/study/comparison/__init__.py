# SPDX-License-Identifier: Apache-2.0
"""Depth methods side by side (``preset=benchmark``): scenes, rigs and disturbances in tracks."""
