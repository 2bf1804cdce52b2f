# SPDX-License-Identifier: Apache-2.0
"""Convolutions on panoramas and cube maps that know the sphere."""
