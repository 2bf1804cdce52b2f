# SPDX-License-Identifier: Apache-2.0
"""The paper's study: models, tilted rigs, tables and pictures; and the benchmark of depth methods."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from sphericalvision.recipes.app.command import command

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["main", "run"]


def run(config: DictConfig, folder: Path) -> Any:
    """The study, or with ``preset=benchmark`` the benchmark of methods."""
    if "benchmark" in config:
        from sphericalvision.recipes.study.benchmark import compare

        return compare(config, folder)
    from sphericalvision.recipes.study.command import study

    return study(config, folder)


main = command("study", "study:run")
