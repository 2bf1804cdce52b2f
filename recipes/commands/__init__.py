# SPDX-License-Identifier: Apache-2.0
"""The work of each command, once its configuration is read."""
