# SPDX-License-Identifier: Apache-2.0
"""What ``sphericalvision-predict`` is made of: sources of frames, threads around the network, files of results."""
