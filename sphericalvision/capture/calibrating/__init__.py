# SPDX-License-Identifier: Apache-2.0
"""Cameras and rigs from pictures: of boards, of points, of anything."""
