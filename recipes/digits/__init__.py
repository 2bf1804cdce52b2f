# SPDX-License-Identifier: Apache-2.0
"""Digits on the sphere: the primitives in another task."""
