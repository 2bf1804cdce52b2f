# SPDX-License-Identifier: Apache-2.0
"""``--help``: every key of a command with its value and its comment in the YAML files."""

import itertools
import re
from collections.abc import Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

from hydra import compose
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from omegaconf import DictConfig, OmegaConf

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
    sources = _Sources(config.hydra.searchpath)
    choices = {g: c for g, c in config.hydra.runtime.choices.items() if not g.startswith("hydra/")}
    comments = sources.comments(config_name, "")
    print("\n".join(heading(sources.text(config_name))))
    if choices:
        print("\nGroups (GROUP=OPTION):")
    for group, choice in choices.items():
        name, _, package = group.partition("@")
        print(f"  {group}={choice}   one of {' | '.join(options_of(name, config_name, overrides))}")
        if choice is not None:
            is_global = sources.text(f"{name}/{choice}").startswith("# @package _global_")
            comments = sources.comments(f"{name}/{choice}", package or ("" if is_global else name)) | comments
    print("\nKeys (KEY=VALUE):")
    rows = [
        (f"{key}={_written(value)}", comments.get(key, ""))
        for key, value in walk(OmegaConf.to_container(config))
        if not re.search(r"^hydra\b|(^|\.)_", key) and not (isinstance(value, dict) and value)
    ]
    width = min(44, max(len(word) for word, _ in rows))
    for word, comment in rows:
        print(f"  {word:{width}}  # {comment}" if comment else f"  {word}")
    print(FLAGS)


def options_of(group: str, config_name: str, overrides: Sequence[str] = ()) -> list[str]:
    """Options of a group of a command, without those that others only inherit from."""
    loader = GlobalHydra.instance().config_loader()
    options = loader.get_group_options(group, ObjectType.CONFIG, config_name, list(overrides))
    return [option for option in options if not option.startswith("_")]


class Key(NamedTuple):
    """One key of a file: its dotted name, its value as written, and its comment."""

    name: str
    value: str
    comment: str


def read_keys(text: str) -> Iterator[Key]:
    """Keys of a YAML file, in their order, those that hold further keys included."""
    path: list[tuple[int, str]] = []  # indentation and name of each key that the line is within
    for line in re.sub(r"^defaults:\n(?: +.*\n|\n)*", "", text, flags=re.M).splitlines():
        if match := re.match(r"^( *)([\w/]+): *(.*?)(?:(?:^| +)# (.*))?$", line):
            depth = len(match[1])
            path = [(d, key) for d, key in path if d < depth] + [(depth, match[2])]
            yield Key(".".join(key for _, key in path), match[3], match[4] or "")


def heading(text: str) -> list[str]:
    """The comment at the top of a file."""
    lines = itertools.takewhile(lambda line: line.startswith("#"), text.splitlines())
    return [line.removeprefix("# ") for line in lines if "@package" not in line and "SPDX" not in line]


def keys_of(config: DictConfig) -> list[str]:
    """All keys of a config, nested ones with dots; values are not resolved."""
    return [key for key, _ in walk(OmegaConf.to_container(config))]


def walk(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Keys and values of tables within each other, each before those within it."""
    for key, value in config.items():
        yield f"{prefix}{key}", value
        if isinstance(value, dict):
            yield from walk(value, f"{prefix}{key}.")


def _written(value: Any) -> str:
    """A value as it would be written on a command line."""
    if isinstance(value, (list, dict)):
        return str(value).replace(" ", "").replace("'", "")
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


class _Sources:
    """The YAML files behind a configuration, as text; ``search_path`` adds to what Hydra knows from its start."""

    def __init__(self, search_path: Sequence[str]) -> None:
        loader: Any = GlobalHydra.instance().config_loader()
        paths = [element.path or "" for element in loader.get_search_path().get_path()]
        self.search_path = [*paths, *search_path]

    def text(self, name: str) -> str:
        """The text of the file ``name``, wherever the search path has it; empty if nowhere."""
        for element in self.search_path:
            scheme, _, folder = element.partition("://")
            if scheme in ("file", "pkg") and not folder.startswith("hydra"):
                path: Any = (Path(folder) if scheme == "file" else files(folder)) / f"{name}.yaml"
                if path.is_file():
                    return str(path.read_text())
        return ""

    def comments(self, name: str, package: str) -> dict[str, str]:
        """Key -> its comment, of a file and of those it inherits from."""
        text = self.text(name)
        comments: dict[str, str] = {}
        group = name.rpartition("/")[0]
        for parent in re.findall(r"^ {2}- (\w+) *(?:#.*)?$", text.partition("defaults:")[2], re.MULTILINE):
            if group and parent != "_self_":
                comments |= self.comments(f"{group}/{parent}", package)
        prefix = f"{package}." if package else ""
        return comments | {f"{prefix}{key.name}": key.comment for key in read_keys(text) if key.comment}
