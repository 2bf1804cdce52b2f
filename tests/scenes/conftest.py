# SPDX-License-Identifier: Apache-2.0
"""The small rig of the data sets' tests."""

from tests.data.conftest import rig  # noqa: F401
