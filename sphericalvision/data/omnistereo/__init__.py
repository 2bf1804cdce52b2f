# SPDX-License-Identifier: Apache-2.0
"""The omnidirectional stereo sets: their layout on disk, reader and writer."""
