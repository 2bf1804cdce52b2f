# SPDX-License-Identifier: Apache-2.0
"""``--help``: every key of a command with its value and the comment that stands beside it in the YAML files."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from hydra import compose
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from omegaconf import DictConfig, ListConfig, OmegaConf

__all__ = ["keys_of", "print_help"]

FLAGS = """
Flags:
  --multirun, -m      several values for a key: seed=0,1,2 (one run each, a table at the end)
  --config-dir DIR    a folder of your own configs, laid out as the groups above
  --cfg job           print the configuration and do nothing
  --version           of this package
"""


def print_help(config_name: str, overrides: list[str]) -> None:
    """Print what the command is for, its groups with their options, and its keys as ``overrides`` leave them."""
    config = compose(config_name, overrides, return_hydra_config=True)
    sources = _Sources()
    choices = {g: c for g, c in config.hydra.runtime.choices.items() if not g.startswith("hydra/")}
    comments = sources.comments(config_name, "")
    print("\n".join(line.removeprefix("# ") for line in sources.heading(config_name)))
    if choices:
        print("\nGroups (GROUP=OPTION):")
    for group, choice in choices.items():
        name, _, package = group.partition("@")
        print(f"  {group}={choice}   one of {' | '.join(sources.options(name))}")
        if choice is not None:
            package = "" if not package and sources.is_global(f"{name}/{choice}") else package or name
            comments = sources.comments(f"{name}/{choice}", package) | comments
    print("\nKeys (KEY=VALUE):")
    rows = [(f"{key}={value}", comments.get(key, "")) for key, value in _leaves(config)]
    width = min(44, max(len(word) for word, _ in rows))
    for word, comment in rows:
        print(f"  {word:{width}}  # {comment}" if comment else f"  {word}")
    print(FLAGS)


def keys_of(config: Any, prefix: str = "") -> list[str]:
    """All keys of a config, nested ones with dots; values are not resolved."""
    keys = []
    for key in map(str, config):
        keys.append(f"{prefix}{key}")
        node = config._get_node(key)
        if isinstance(node, DictConfig) and not node._is_none() and not node._is_missing():
            if node._is_interpolation():
                continue
            keys += keys_of(node, f"{prefix}{key}.")
    return keys


def _leaves(config: DictConfig, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Keys and values as they would be written on a command line; nothing is resolved."""
    for key in map(str, config):
        node = config._get_node(key)
        assert node is not None
        if f"{prefix}{key}" == "hydra" or str(key).startswith("_"):
            continue
        nested = isinstance(node, DictConfig) and not (
            node._is_none() or node._is_missing() or node._is_interpolation()
        )
        if nested and len(node):  # type: ignore[arg-type]
            yield from _leaves(node, f"{prefix}{key}.")  # type: ignore[arg-type]
        else:
            yield f"{prefix}{key}", _written(node)


def _written(node: Any) -> str:
    if node._is_none():
        return "null"
    if node._is_missing():
        return "???"
    if node._is_interpolation():
        return str(node._value())
    if isinstance(node, (ListConfig, DictConfig)):
        return str(OmegaConf.to_container(node)).replace(" ", "").replace("'", "")
    value = node._value()
    return str(value).lower() if isinstance(value, bool) else str(value)


class _Sources:
    """The YAML files behind a configuration, as text."""

    def __init__(self) -> None:
        self.loader: Any = GlobalHydra.instance().config_loader()

    def options(self, group: str) -> list[str]:
        """Names of the files of a group."""
        return list(self.loader.get_group_options(group, ObjectType.CONFIG))

    def heading(self, name: str) -> list[str]:
        """The comment at the top of a file."""
        lines = []
        for line in self._text(name).splitlines():
            if not line.startswith("#"):
                break
            if "@package" not in line:
                lines.append(line)
        return lines

    def is_global(self, name: str) -> bool:
        """Whether the keys of a file are the command's own."""
        return self._text(name).startswith("# @package _global_")

    def comments(self, name: str, package: str) -> dict[str, str]:
        """Key -> the comment beside it, of a file and of those it inherits from."""
        text = self._text(name)
        found: dict[str, str] = {}
        group = name.rpartition("/")[0]
        for parent in re.findall(r"^ {2}- (\w+) *(?:#.*)?$", text.partition("defaults:")[2], re.MULTILINE):
            if group and parent != "_self_":
                found |= self.comments(f"{group}/{parent}", package)
        path: list[tuple[int, str]] = []
        for line in text.splitlines():
            match = re.match(r"^( *)([\w]+):(.*)$", line)
            if match is None:
                continue
            depth = len(match[1])
            path = [(d, key) for d, key in path if d < depth] + [(depth, match[2])]
            comment = re.search(r"(?:^|\s)# (.*)$", match[3])
            if comment:
                found[".".join([*([package] if package else []), *(key for _, key in path)])] = comment[1]
        return found

    def _text(self, name: str) -> str:
        """The text of the file ``name``, wherever the search path has it."""
        from importlib.resources import files
        from pathlib import Path

        for element in self.loader.get_search_path().get_path():
            scheme, _, place = (element.path or "").partition("://")
            if scheme == "file":
                path: Any = Path(place) / f"{name}.yaml"
            elif scheme == "pkg" and not place.startswith("hydra"):
                package, *folders = name.split("/")
                path = (
                    files(place).joinpath(*[package, *folders[:-1]], f"{folders[-1]}.yaml")
                    if folders
                    else (files(place) / f"{package}.yaml")
                )
            else:
                continue
            if path.is_file():
                return str(path.read_text())
        return ""
