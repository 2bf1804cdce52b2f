# SPDX-License-Identifier: Apache-2.0
"""Frames of a capture: files, videos, live cameras."""
