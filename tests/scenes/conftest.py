# SPDX-License-Identifier: Apache-2.0
"""The small rig of the data sets' tests, and frames of noise for it."""

from tests.data.conftest import frames, make_frames, make_rig, rig  # noqa: F401
