# SPDX-License-Identifier: Apache-2.0
"""Command lines of functions. Imports nothing heavy, so that ``--help`` and mistakes are answered at once."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import is_dataclass
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin, get_type_hints

if TYPE_CHECKING:
    from omegaconf import DictConfig

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
"""Packages that the extra ``recipes`` brings."""


class Command:
    """The ``main`` of a command, which imports what does the work once the command line has been read.

    A key that makes no sense is an ``ArgumentError`` that names it, and a file that cannot be read a
    ``FileFormatError``: whatever does the work raises them, and they end it with one paragraph and status 1.

    Args:
        name: of its configuration, ``conf/NAME.yaml``.
        task: the function that does the work, as ``module:function`` in ``sphericalvision.recipes``; the one of this
            name in ``recipes/commands`` if not given. It takes the configuration and, if it has a second parameter, the
            folder of the run.
    """

    def __init__(self, name: str, task: str | None = None) -> None:
        self.name = name
        self.task = task or f"commands.{name}:{name}"

    def __call__(self, words: Sequence[str] | None = None) -> None:
        """Run the command with some words, those of the command line if not given."""
        try:
            from sphericalvision.recipes.app.running import run_command

            run_command(self, sys.argv[1:] if words is None else [*words])
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] not in NEEDED:
                raise
            print(
                f"Error: the commands need more than the library ({error.name} is not installed): "
                "pip install 'sphericalvision[recipes]'",
                file=sys.stderr,
            )
            raise SystemExit(1) from None
        except KeyboardInterrupt:
            print("\nInterrupted.", file=sys.stderr)
            raise SystemExit(130) from None

    @property
    def function(self) -> Callable[..., Any]:
        """The function that does the work."""
        module, _, name = self.task.partition(":")
        work: Callable[..., Any] = getattr(importlib.import_module(f"sphericalvision.recipes.{module}"), name)
        return work

    @property
    def keys(self) -> Any:
        """The types of its keys: the dataclass that the function takes, or of a ``DictConfig`` its annotation."""
        hint = next(iter(get_type_hints(self.function, include_extras=True).values()))
        return get_args(hint)[1] if get_origin(hint) is Annotated else hint

    def work(self, config: DictConfig) -> Any:
        """Do the work of a run that Hydra has begun."""
        from hydra.core.hydra_config import HydraConfig

        from sphericalvision.recipes.app.checks import typed

        keys = typed(self.keys, config)
        folder = Path(HydraConfig.get().runtime.output_dir).absolute()  # right in multi-runs
        return self.call(keys if is_dataclass(keys) else config, folder)

    def call(self, config: Any, folder: Path) -> Any:
        """Call the function with its configuration and, if it wants that, the folder of the run."""
        arguments = (config, folder)[: len(signature(self.function).parameters)]
        return self.function(*arguments)
