# SPDX-License-Identifier: Apache-2.0
"""What the commands share: configs made into objects, configs and tables printed, the device."""

from __future__ import annotations

from dataclasses import is_dataclass
from importlib.metadata import metadata
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.errors import InstantiationException
from omegaconf import DictConfig, ListConfig, OmegaConf
from rich.console import Console
from rich.syntax import Syntax
from rich.table import Table
from rich.tree import Tree

from sphericalvision.core import ArgumentError, SphericalVisionError
from sphericalvision.io.files import write_bytes
from sphericalvision.recipes.app.checks import check_node, flat

__all__ = [
    "build",
    "choose_device",
    "console",
    "print_config",
    "print_table",
    "say",
]

console = Console(markup=False)  # brackets in names are no styles


def build(config: Any, where: str = "", **kwargs: Any) -> Any:
    """Instantiate a config node's ``_target_``; the only place where configs become objects.

    Args:
        config: the node.
        where: its key, for messages.
        **kwargs: further arguments of the target.

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
        if isinstance(cause, ModuleNotFoundError):
            raise ArgumentError(f"{where}: {_missing_package(where, cause)}") from error
        if isinstance(cause, (ValueError, TypeError)) or type(cause).__name__ == "MisconfigurationException":
            target = str(config.get("_target_")).rpartition(".")[2]
            raise ArgumentError(f"{where}: {target} refuses these values: {cause}") from error
        raise


def _missing_package(where: str, error: ModuleNotFoundError) -> str:
    """What to install: an extra of this package, if one has the name of the node."""
    name = where.rpartition(".")[2]
    extras = metadata("sphericalvision").get_all("Provides-Extra") or []
    command = f"'sphericalvision[{name}]'" if name in extras else error.name or "the package it names"
    return f"needs what is not installed ({str(error).splitlines()[0]}): pip install {command}"


def print_config(config: Any, folder: Path | None = None) -> None:
    """Print the resolved config, or the keys of a dataclass, as a tree; keep it as ``config.yaml`` in ``folder``."""
    node = OmegaConf.create(flat(config)) if is_dataclass(config) else config
    resolved = OmegaConf.create(OmegaConf.to_container(node, resolve=True, throw_on_missing=False))
    tree = Tree("config")
    for key, value in resolved.items():
        if isinstance(value, (DictConfig, ListConfig)):
            tree.add(str(key)).add(
                Syntax(OmegaConf.to_yaml(value).rstrip(), "yaml", background_color="default")
            )
        else:
            tree.add(f"{key!s}: {value}", highlight=True)
    console.print(tree)
    if folder is not None:
        write_bytes(folder / "config.yaml", OmegaConf.to_yaml(resolved).encode())


def say(text: str, style: str | None = None) -> None:
    """Print a line as it is."""
    console.print(text, style=style, highlight=False, soft_wrap=True)


def print_table(title: str, columns: list[str], rows: list[list[str]]) -> None:
    """Print rows of text as a table, numbers to the right."""
    table = Table(title=title, title_justify="left")
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i == 0 else "right", overflow="fold")
    for row in rows:
        table.add_row(*row)
    console.print(table)


def choose_device(device: str) -> torch.device:
    """The device of a ``device=`` value; ``auto`` is a GPU where there is one.

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
