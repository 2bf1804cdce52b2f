# SPDX-License-Identifier: Apache-2.0
"""The paper's study: models, tilted rigs, tables and pictures."""

from sphericalvision.recipes.study.command import main, study

__all__ = ["main", "study"]
