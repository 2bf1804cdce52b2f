# SPDX-License-Identifier: Apache-2.0
"""What a camera model says of itself so that it can be fitted to another camera: its intrinsics and where to start."""
