# SPDX-License-Identifier: Apache-2.0
"""The paper's study: models, tilted rigs, tables and pictures; and the benchmark of depth methods."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sphericalvision.recipes.app.command import command, output_folder

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["main"]


@command("study")
def main(config: DictConfig) -> Any:
    """Command line of the study."""
    if "benchmark" in config:
        from sphericalvision.recipes.study.comparison.command import compare

        return compare(config, output_folder())
    from sphericalvision.recipes.study.command import study

    return study(config, output_folder())
