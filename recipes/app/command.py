# SPDX-License-Identifier: Apache-2.0
"""Command lines of functions. Imports nothing heavy, so that ``--help`` and mistakes are answered at once."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["command"]

NEEDED = (
    "hydra",
    "omegaconf",
    "pydantic",
    "annotated_types",
    "rich",
    "pytorch_lightning",
    "tensorboard",
    "sklearn",
)
"""What the extra ``recipes`` brings."""


class Main(Protocol):
    """The function of a console script."""

    def __call__(self, words: Sequence[str] | None = None) -> None:
        """Do what the command does with some words, those of the command line if not given."""


def command(name: str, task: str | None = None, folder: bool = True) -> Main:
    """The ``main`` of a command, which imports what does the work once the command line has been read.

    Args:
        name: of its configuration, ``conf/NAME.yaml``.
        task: the function that does the work, as ``module:function`` in ``sphericalvision.recipes``; the one of this
            name in ``recipes/commands`` if not given. It gets the configuration.
        folder: whether it gets the folder of the run, too.
    """

    def main(words: Sequence[str] | None = None) -> None:
        try:
            from sphericalvision.recipes.app.running import run_command
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] not in NEEDED:
                raise
            print(
                f"Error: the commands need more than the library ({error.name} is not installed): "
                "pip install 'sphericalvision[recipes]'",
                file=sys.stderr,
            )
            raise SystemExit(1) from None
        words = sys.argv[1:] if words is None else [*words]
        run_command(name, partial(_work, task or f"commands.{name}:{name}", folder), words)

    return main


def _work(task: str, folder: bool, config: DictConfig) -> Any:
    from hydra.core.hydra_config import HydraConfig

    module, _, function = task.partition(":")
    work = getattr(importlib.import_module(f"sphericalvision.recipes.{module}"), function)
    # absolute, and right in multi-runs
    return work(config, Path(HydraConfig.get().runtime.output_dir).absolute()) if folder else work(config)
