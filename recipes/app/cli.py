# SPDX-License-Identifier: Apache-2.0
"""What the commands share: paths taken literally, configs made into objects, configs and tables printed."""

from __future__ import annotations

import functools
import os
import re
import sys
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, ListConfig, OmegaConf
from rich.console import Console
from rich.syntax import Syntax
from rich.table import Table
from rich.tree import Tree

from sphericalvision.core import ArgumentError
from sphericalvision.recipes.app.errors import check_overrides, plain_errors

__all__ = [
    "build",
    "choose_device",
    "command",
    "console",
    "name_rigs",
    "output_folder",
    "print_config",
    "print_table",
    "quote_paths",
    "unquote_paths",
]

console = Console()

PATH_KEYS = {
    "rig",
    "calibration",
    "images",
    "masks",
    "checkpoint",
    "output",
    "resume",
    "init_weights",
    "root",
    "cache_dir",
    "runs",
    "path",
}
"""Last parts of the keys whose values are file names: what stands there is a name, never Hydra's grammar."""


def quote_paths(arguments: list[str]) -> list[str]:
    """Quote values of path keys, so that braces, commas and equal signs in file names need no second quoting.

    Examples:
        >>> quote_paths(["images=/data/cam{camera}/{frame:05d}.png", "frames=[1,2]"])
        ["images='/data/cam{camera}/{frame:05d}.png'", 'frames=[1,2]']
    """
    return [_quote_path(argument) for argument in arguments]


def name_rigs(config_name: str, arguments: list[str]) -> list[str]:
    """Let ``rig=equirect4`` mean ``scene_rig=equirect4`` in commands that see scenes through a rig of that group.

    Commands that want the file of a rig (``rig=capture/config.yaml``) keep their words.

    Examples:
        >>> name_rigs("evaluate", ["rig=equirect4"]), name_rigs("predict", ["rig=equirect4"])
        (['scene_rig=equirect4'], ['rig=equirect4'])
    """
    conf = files("sphericalvision.conf")
    if "\n  - scene_rig:" not in (conf / f"{config_name}.yaml").read_text():
        return arguments
    names = {file.name.removesuffix(".yaml") for file in (conf / "scene_rig").iterdir()}
    return [
        f"scene_{word}" if word.startswith("rig=") and names.issuperset(word[4:].split(",")) else word
        for word in arguments
    ]


def unquote_paths(arguments: list[str]) -> list[str]:
    """Take off the quotes that ``quote_paths`` put on, for showing a command line.

    Examples:
        >>> unquote_paths(quote_paths(["output=my run"]))
        ['output=my run']
    """
    return [_unquote_path(argument) for argument in arguments]


def _unquote_path(argument: str) -> str:
    match = re.match(r"^([\w./@]+)='(.*)'$", argument, re.DOTALL)
    if match is None:
        return argument
    return f"{match[1]}=" + re.sub(r"(\\+)('|$)", lambda end: end[1][: len(end[1]) // 2] + end[2], match[2])


def _quote_path(argument: str) -> str:
    match = re.match(r"^([\w./@]+)=(.*)$", argument, re.DOTALL)
    if match is None or match[1].split(".")[-1] not in PATH_KEYS:
        return argument
    value = match[2]
    if value in ("", "null", "auto") or value[0] in "'\"" or "${" in value:
        return argument
    literal = os.path.expanduser(value)
    escaped = re.sub(r"(\\*)('|$)", lambda end: end[1] * 2 + (r"\'" if end[2] else ""), literal)
    return f"{match[1]}='{escaped}'"


def command(config_name: str) -> Callable[[Callable[[DictConfig], None]], Callable[[], None]]:
    """Make a command line of ``task``, which gets the config ``config_name`` with the user's changes."""

    def decorate(task: Callable[[DictConfig], None]) -> Callable[[], None]:
        hydra_main = hydra.main(
            version_base="1.3", config_path="pkg://sphericalvision.conf", config_name=config_name
        )(plain_errors(task))

        @functools.wraps(task)
        def main() -> None:
            sys.argv[1:] = quote_paths(name_rigs(config_name, sys.argv[1:]))
            check_overrides(config_name, sys.argv[1:])
            hydra_main()

        return main

    return decorate


def build(config: Any, *args: Any, **kwargs: Any) -> Any:
    """Instantiate a config node's ``_target_``; the only place where configs become objects."""
    return hydra.utils.instantiate(config, *args, _convert_="all", **kwargs)


def output_folder() -> Path:
    """The folder of this run, absolute; also right in multi-runs."""
    return Path(HydraConfig.get().runtime.output_dir).absolute()


def print_config(config: DictConfig, folder: Path | None = None) -> None:
    """Print the resolved config as a tree; keep it as ``config.yaml`` in ``folder``."""
    resolved = OmegaConf.create(OmegaConf.to_container(config, resolve=True, throw_on_missing=False))
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
        folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(resolved, folder / "config.yaml")


def print_table(title: str, columns: list[str], rows: list[list[str]]) -> None:
    """Print rows of text as a table, numbers to the right."""
    table = Table(title=title, title_justify="left")
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i == 0 else "right")
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
        reason = str(error).splitlines()[0]
        raise ArgumentError(f"device: expected auto, cpu or cuda, got {device!r} ({reason})") from None
