# SPDX-License-Identifier: Apache-2.0
"""Makes a function a command line. Imports nothing heavy, so that ``--help`` and mistakes are answered at once."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["command", "output_folder"]

NEEDED = ("hydra", "omegaconf", "rich", "pytorch_lightning", "tensorboard", "sklearn")
"""What the extra ``recipes`` brings."""


def command(config_name: str) -> Callable[[Callable[[DictConfig], Any]], Callable[[], None]]:
    """Make a command line of a function that gets the config ``config_name`` with the user's changes."""

    def decorate(task: Callable[[DictConfig], Any]) -> Callable[[], None]:
        @functools.wraps(task)
        def main() -> None:
            try:
                from sphericalvision.recipes.app.running import run_command
            except ModuleNotFoundError as error:
                if (error.name or "").partition(".")[0] not in NEEDED:
                    raise
                _exit_without_recipes(error.name)
            run_command(config_name, task)

        return main

    return decorate


def output_folder() -> Path:
    """The folder of this run, absolute; also right in multi-runs."""
    from hydra.core.hydra_config import HydraConfig

    return Path(HydraConfig.get().runtime.output_dir).absolute()


def _exit_without_recipes(missing: str | None) -> None:
    print(
        f"Error: the commands need more than the library ({missing} is not installed): "
        "pip install 'sphericalvision[recipes]'",
        file=sys.stderr,
    )
    raise SystemExit(1)
