# SPDX-License-Identifier: Apache-2.0
"""Speed, measured beside a plain way to do the same."""

from sphericalvision.recipes.benchmark.command import GROUPS, benchmark, main

__all__ = ["GROUPS", "benchmark", "main"]
