# SPDX-License-Identifier: Apache-2.0
"""What exists for speed alone."""
