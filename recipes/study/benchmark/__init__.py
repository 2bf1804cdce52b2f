# SPDX-License-Identifier: Apache-2.0
"""The benchmark of depth methods: scenes, rigs and disturbances in tracks, every method side by side."""
