# SPDX-License-Identifier: Apache-2.0
"""Point location for many directions at once."""
