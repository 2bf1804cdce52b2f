# SPDX-License-Identifier: Apache-2.0
"""Pictures and exact depth of a scene, through any camera."""
