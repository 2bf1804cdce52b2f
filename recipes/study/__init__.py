# SPDX-License-Identifier: Apache-2.0
"""The paper's study: models, tilted rigs, tables and pictures."""

from sphericalvision.recipes.app.command import Command

__all__ = ["main"]

main = Command("study", "study.command:study")
