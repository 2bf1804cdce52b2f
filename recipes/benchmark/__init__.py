# SPDX-License-Identifier: Apache-2.0
"""Speed, measured beside a plain way to do the same."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sphericalvision.recipes.app.command import command, output_folder

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["main"]


@command("benchmark")
def main(config: DictConfig) -> Any:
    """Command line of the benchmark."""
    from sphericalvision.recipes.benchmark.command import benchmark

    return benchmark(config, output_folder())
