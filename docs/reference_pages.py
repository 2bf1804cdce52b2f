# SPDX-License-Identifier: Apache-2.0
"""Reference pages that write themselves: tables of public names by theme, and of every key of every configuration file.

``on_page_markdown`` is called by MkDocs and puts a table of names above each ``::: sphericalvision.…`` of the API's
pages; ``::: sphericalvision.… from base, models`` is the part of a package whose names come from these files and
folders.
``configuration_tables`` is called by the page of keys.
"""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from pathlib import Path
from typing import Any

import yaml

from sphericalvision.recipes.app.checks import expected
from sphericalvision.recipes.app.help import Key, heading, read_keys
from sphericalvision.recipes.app.keys import type_of as type_of_key

ROOT = Path(__file__).resolve().parents[1]
BLOCK = r"^::: (sphericalvision\.\w+)(?: from ([\w., ]+))?$"
"""A package in a page of the API, or a part of it."""


def first_sentence(doc: str | None) -> str:
    """First sentence of a docstring on one line, fit for a cell of a table."""
    paragraph = " ".join((doc or "").strip().partition("\n\n")[0].split())
    sentence = re.split(r"(?<=[.!?])\s+(?=[A-Z`])", paragraph)[0].replace("``", "`")
    # Shapes have bars and brackets that a table or Markdown would take for its own.
    outside = re.split(r"(`[^`]*`)", sentence)
    return "".join(
        part if part.startswith("`") else re.sub(r"([\[\]*_<])", r"\\\1", part) for part in outside
    ).replace("|", "\\|")


def exported(module_name: str, homes: str | None = None) -> list[str]:
    """Names that a package exports; of some of its files and folders alone, if ``homes`` lists them."""
    package = importlib.import_module(module_name)
    if homes is None:
        return list(package.__all__)
    places = tuple(f"{module_name}.{home.strip()}." for home in homes.split(","))
    return [
        name
        for name in package.__all__
        if f"{getattr(inspect.getmodule(getattr(package, name)), '__name__', '')}.".startswith(places)
    ]


def names_tables(module_name: str, names: list[str]) -> str:
    """Some names that a package exports, by the file they come from, with the first sentence of each."""
    package = importlib.import_module(module_name)
    themes: dict[str, list[str]] = {}
    for name in names:
        value = getattr(package, name)
        home = inspect.getmodule(value)
        theme = (
            first_sentence(home.__doc__)
            if home is not None and home is not package
            else "Constants and types."
        )
        doc = value.__doc__ if inspect.isroutine(value) or inspect.isclass(value) else None
        address = (
            f"{home.__name__}.{name}" if home and is_hidden(module_name, name) else f"{module_name}.{name}"
        )
        themes.setdefault(theme, []).append(f"| [`{name}`](#{address}) | {first_sentence(doc)} |")
    parts = [
        f"**{theme.rstrip('.')}**\n\n| name | |\n|---|---|\n" + "\n".join(rows)
        for theme, rows in sorted(themes.items(), key=lambda item: item[0].startswith("Constants"))
    ]
    return "\n\n".join(parts)


def is_hidden(module_name: str, name: str) -> bool:
    """Whether a package exports a function whose file has the same name: Griffe sees the file alone."""
    value = getattr(importlib.import_module(module_name), name)
    home = inspect.getmodule(value)
    if home is None or home.__name__.rpartition(".")[2] != name:
        return False
    parent = home.__name__.rpartition(".")[0]
    return parent == module_name or getattr(sys.modules[parent], name, None) is value


def hidden_names(module_name: str, names: list[str]) -> str:
    """Blocks for the functions that ``is_hidden`` tells."""
    package = importlib.import_module(module_name)
    hidden = [name for name in names if is_hidden(module_name, name)]
    return "".join(f"\n\n::: {getattr(package, name).__module__}.{name}" for name in hidden)


def on_page_markdown(markdown: str, page: Any, **_: object) -> str:
    """Put the tables of names above what MkDocs makes of the docstrings."""
    if not page.file.src_uri.startswith("api/"):
        return markdown
    hidden = []

    def block(found: re.Match[str]) -> str:
        names = exported(found[1], found[2])
        hidden.append(hidden_names(found[1], names))
        options = "show_root_heading: false, show_root_toc_entry: false, show_submodules: false"
        members = f", members: [{', '.join(names)}]" if found[2] else ""
        return f"{names_tables(found[1], names)}\n\n::: {found[1]}\n    options: {{{options}{members}}}"

    return re.sub(BLOCK, block, markdown, flags=re.M) + "".join(hidden)


def type_of(key: Key, path: Path) -> str:
    """What may be put in: from the command's types, or else as the default is."""
    if path.parent.name == "conf" and (hint := type_of_key(path.stem, key.name)) is not None:
        return expected(hint)
    value = yaml.safe_load(key.value or "null") if not key.value.startswith(("$", "?")) else None
    words = {
        bool: "true or false",
        int: "a whole number",
        float: "a number",
        str: "text",
        list: "a list",
        dict: "a table",
    }
    return words.get(type(value), "")


def configuration_tables() -> str:
    """Every file of ``conf/`` with its keys, commands first, then the groups."""
    parts = []
    files = sorted((ROOT / "conf").glob("*.yaml")) + sorted((ROOT / "conf").glob("*/*.yaml"))
    group = None
    for path in files:
        text = path.read_text()
        command = path.parent.name == "conf"
        if group != (here := "Commands" if command else f"`{path.parent.name}=…`"):
            group = here
            parts.append(f"## {group}\n")
        name = f"sphericalvision-{path.stem}" if command else f"{path.parent.name}={path.stem}"
        parts.append(f"### `{name}`\n\n{' '.join(heading(text))}\n")
        parents = re.findall(r"^ {2}- (\w+)\s*$", text.partition("defaults:")[2], re.M)
        if parents := [parent for parent in parents if parent != "_self_"]:
            parts.append(f"As {', '.join(f'`{parent}`' for parent in parents)}, and:\n")
        groups = re.findall(r"^ {2}- (\w+): ", text.partition("defaults:")[2], re.M) if command else []
        if groups:
            parts.append(f"Keys of groups: {', '.join(f'[`{name}`](#{name})' for name in groups)}.\n")
        rows = [
            f"| `{key.name}` | {cell(key.value)} | {type_of(key, path)} | {key.comment.replace('|', chr(92) + '|')} |"
            for key in read_keys(text)
            if (key.value or key.comment) and not re.search(r"^hydra\b|_partial_$", key.name)
        ]
        if rows:
            parts.append("| key | default | type | |\n|---|---|---|---|\n" + "\n".join(rows) + "\n")
    return "\n".join(parts)


def cell(value: str) -> str:
    """A value in code, or nothing."""
    return f"`{value.replace('|', chr(92) + '|')}`" if value else ""
