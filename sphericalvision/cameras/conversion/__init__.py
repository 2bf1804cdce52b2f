# SPDX-License-Identifier: Apache-2.0
"""Any camera as another model."""
