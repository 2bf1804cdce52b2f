# SPDX-License-Identifier: Apache-2.0
"""Helpers of all commands: objects from configs, printed configs and tables, the device."""

import time
from collections.abc import Container, Iterable, Iterator, Mapping, Sized
from dataclasses import is_dataclass
from datetime import timedelta
from importlib.metadata import metadata
from pathlib import Path
from typing import Any, TypeVar

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from omegaconf import OmegaConf
from rich import progress
from rich.console import Console
from rich.table import Table

from sphericalvision.core import ArgumentError, FileFormatError, SphericalVisionError
from sphericalvision.io.files import write_bytes
from sphericalvision.io.yaml_files import read_yaml
from sphericalvision.recipes.app.checks import check_node, flat
from sphericalvision.recipes.app.words import unquote_paths

T = TypeVar("T")

PROGRESS = 15.0
"""Seconds between lines of progress where no terminal can draw a bar: in log files and job queues."""


class _Console(Console):
    """A console that leaves a closed pipe to the command; rich would end it with status 1 and no word."""

    def on_broken_pipe(self) -> None:
        """Raise what rich has caught."""
        raise BrokenPipeError


console = _Console(markup=False)  # brackets in names are no styles


def build(config: Any, where: str = "", **kwargs: Any) -> Any:
    """Instantiate the ``_target_`` of the node at key ``where``; the only place where configs become objects.

    Raises:
        ArgumentError: the target does not take one of the keys, or refuses a value; the message names it.
    """
    check_node(config, where, tuple(kwargs))
    try:
        return hydra.utils.instantiate(config, _convert_="all", **kwargs)
    except InstantiationException as error:
        cause = error.__cause__
        if isinstance(cause, (SphericalVisionError, OSError)):
            raise cause from None
        # Of an extra of this package, if one has the name of the node
        if isinstance(cause, ModuleNotFoundError):
            name = where.rpartition(".")[2]
            extras = metadata("sphericalvision").get_all("Provides-Extra") or []
            command = f"'sphericalvision[{name}]'" if name in extras else cause.name or "the package it names"
            raise ArgumentError(
                f"{where}: needs what is not installed ({str(cause).splitlines()[0]}): pip install {command}"
            ) from error
        if isinstance(cause, (ValueError, TypeError)) or type(cause).__name__ == "MisconfigurationException":
            target = str(config.get("_target_")).rpartition(".")[2]
            raise ArgumentError(f"{where}: {target} refuses these values: {cause}") from error
        raise


def print_config(config: Any, folder: Path | None = None) -> None:
    """Print how a configuration differs from the defaults: the words of the command line.

    All of it, of a dataclass of keys as well, is written to ``config.yaml`` in the folder.
    """
    overrides = unquote_paths(list(HydraConfig.get().overrides.task)) if HydraConfig.initialized() else []
    say("Configuration, as it differs from the defaults:" if overrides else "Configuration: the defaults")
    for word in overrides:
        say(f"  {word}")
    if folder is not None:
        node = OmegaConf.create(flat(config)) if is_dataclass(config) else config
        resolved = OmegaConf.create(OmegaConf.to_container(node, resolve=True, throw_on_missing=False))
        write_bytes(folder / "config.yaml", OmegaConf.to_yaml(resolved).encode())
        say(f"All of it is in {folder / 'config.yaml'}")


def read_settings(path: Path) -> dict[str, Any]:
    """Settings that an earlier run left in a file, by key; none without the file.

    Raises:
        FileFormatError: the file is damaged.
    """
    if not path.is_file():
        return {}
    settings = read_yaml(path)
    if not isinstance(settings, dict):
        raise FileFormatError(
            f"{path}: expected the settings of the run that wrote it; choose another output=..., or remove that folder"
        )
    return settings


def check_settings(
    folder: Path, earlier: Mapping[str, Any], settings: Mapping[str, Any], free: Container[str] = ()
) -> None:
    """Refuse to mix results of other settings into a folder, but for the settings that are ``free``.

    Raises:
        ArgumentError: a setting is another than that of the earlier run, if there was one.
    """
    # As text: to YAML 1e-5 is a word, to Python a number; and YAML has no tuples.
    old, new = (
        {
            key: str(list(value) if isinstance(value, tuple) else value)
            for key, value in values.items()
            if value is not None and key not in free
        }
        for values in (earlier, settings)
    )
    if earlier and (differing := changes(old, new)):
        raise ArgumentError(
            f"output: {folder} holds results of other settings ({', '.join(differing)}); set them as before, choose "
            "another output=..., or remove that folder"
        )


def changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Each key whose value differs, with both values."""
    keys = [key for key in {**old, **new} if old.get(key) != new.get(key)]
    return [f"{key} was {old.get(key)}, is {new.get(key)}" for key in keys]


def say(text: str, style: str | None = None) -> None:
    """Print a line without highlighting or wrapping."""
    console.print(text, style=style, highlight=False, soft_wrap=True)


def track(items: Iterable[T], title: str, total: int | None = None, disable: bool = False) -> Iterator[T]:
    """Yield items and show how far they are: a bar on a terminal, elsewhere a line every ``PROGRESS`` seconds.

    Args:
        items: of which there are ``total``, or as many as they have for a length.
        title: of what is done with them.
        total: their number.
        disable: shows nothing.
    """
    number = len(items) if total is None and isinstance(items, Sized) else total
    if console.is_terminal or disable or number is None:
        yield from progress.track(items, title, number, console=console, disable=disable)
        return
    began = shown = time.monotonic()
    for done, item in enumerate(items):
        now = time.monotonic()
        if done and now - shown >= PROGRESS:
            shown = now
            remaining = timedelta(seconds=int((now - began) / done * (number - done)))
            print(f"{title}: {done} of {number}, {remaining} left", flush=True)
        yield item


def print_table(title: str, columns: list[str], rows: list[list[str]]) -> None:
    """Print rows of text as a table, numbers to the right."""
    table = Table(title=title, title_justify="left")
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i == 0 else "right", overflow="fold")
    for row in rows:
        table.add_row(*row)
    console.print(table)


def choose_device(device: str) -> torch.device:
    """Return the device of a ``device=`` value; ``auto`` is a GPU where there is one.

    Raises:
        ArgumentError: torch does not know the device, or this machine does not have it.
    """
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.empty(0, device=device).device
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0].partition("Expected one of")[0] or "torch knows no such device"
        raise ArgumentError(f"device: expected auto, cpu or cuda, got {device!r} ({reason})") from None
