# SPDX-License-Identifier: Apache-2.0
"""Real captures with the points of a scanner: published sets, a file for each, and your own."""
