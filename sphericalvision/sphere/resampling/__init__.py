# SPDX-License-Identifier: Apache-2.0
"""Values from any grid or camera to any other."""
