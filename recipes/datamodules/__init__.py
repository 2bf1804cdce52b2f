# SPDX-License-Identifier: Apache-2.0
"""Training, validation and test data."""
