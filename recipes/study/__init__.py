# SPDX-License-Identifier: Apache-2.0
"""The paper's study: models, tilted rigs, tables and pictures."""

from sphericalvision.recipes.app.command import Command

main = Command("study", "study.command:study")
