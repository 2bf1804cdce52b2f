# SPDX-License-Identifier: Apache-2.0
"""The paper's study: models, tilted rigs, tables and pictures; and the benchmark of depth methods."""

from sphericalvision.recipes.app.command import Command

__all__ = ["main"]

main = Command("study", "study.command:run")
