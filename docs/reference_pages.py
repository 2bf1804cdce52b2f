# SPDX-License-Identifier: Apache-2.0
"""Reference pages that write themselves: tables of public names by theme, and of every key of every configuration file.

``on_page_markdown`` is called by MkDocs and puts a table of names above each ``::: sphericalvision.…`` of the API's
pages; ``::: sphericalvision.… from base, models`` is the part of a package whose names come from these files and
folders. ``::: keys of train`` is the table of keys of a command, and ``::: keys of groups`` that of all groups: MkDocs
then checks their links, as it does those of every page.
"""

from __future__ import annotations

import ast
import functools
import importlib
import inspect
import re
from pathlib import Path
from typing import Any

import yaml

from sphericalvision.recipes.app.checks import expected, hints_of
from sphericalvision.recipes.app.help import Key, heading, read_keys

ROOT = Path(__file__).resolve().parents[1]
BLOCK = r"^::: (sphericalvision\.\w+)(?: from ([\w., ]+))?$"
"""A package in a page of the API, or a part of it."""
KEYS = r"^::: keys of (\w+)$"
"""The keys of a command, or of all groups."""


def first_sentence(doc: str | None) -> str:
    """First sentence of a docstring on one line, fit for a cell of a table."""
    paragraph = " ".join((doc or "").strip().partition("\n\n")[0].split())
    sentence = re.split(r"(?<=[.!?])\s+(?=[A-Z`])", paragraph)[0].replace("``", "`")
    # Shapes have bars and brackets that a table or Markdown would take for its own.
    outside = re.split(r"(`[^`]*`)", sentence)
    return "".join(
        part if part.startswith("`") else re.sub(r"([\[\]*_<])", r"\\\1", part)
        for part in outside
    ).replace("|", "\\|")


def home(module_name: str, name: str) -> str:
    """The module where a name that a package hands on is written, which its stub tells."""
    module = importlib.import_module(module_name)
    stub = Path(module.__file__ or "").with_suffix(".pyi")
    for node in ast.parse(stub.read_text()).body if stub.exists() else ():
        if isinstance(node, ast.ImportFrom) and any(
            alias.name == name for alias in node.names
        ):
            inner = (
                f"{module_name}.{node.module}"
                if node.module
                else f"{module_name}.{name}"
            )
            return home(inner, name) if node.module else inner
    return (
        getattr(inspect.getmodule(getattr(module, name)), "__name__", None)
        or module_name
    )


def exported(module_name: str, homes: str | None = None) -> list[str]:
    """Names that a package exports; of some of its files and folders alone, if ``homes`` lists them."""
    names = importlib.import_module(module_name).__all__
    places = tuple(
        f"{module_name}.{place.strip()}." for place in (homes or "").split(",")
    )
    return [
        name
        for name in names
        if homes is None or f"{home(module_name, name)}.".startswith(places)
    ]


def names_tables(module_name: str, names: list[str]) -> str:
    """Some names that a package exports, by the file they come from, with the first sentence of each."""
    package = importlib.import_module(module_name)
    themes: dict[str, list[str]] = {}
    for name in names:
        value, place = getattr(package, name), home(module_name, name)
        described = (
            inspect.isroutine(value)
            or inspect.isclass(value)
            or inspect.ismodule(value)
        )
        theme = (
            first_sentence(importlib.import_module(place).__doc__)
            if described
            else "Constants and types."
        )
        address = place if inspect.ismodule(value) else f"{place}.{name}"
        doc = first_sentence(value.__doc__) if described else ""
        themes.setdefault(theme, []).append(f"| [`{name}`](#{address}) | {doc} |")
    parts = [
        f"**{theme.rstrip('.')}**\n\n| name | |\n|---|---|\n" + "\n".join(rows)
        for theme, rows in sorted(
            themes.items(), key=lambda item: item[0].startswith("Constants")
        )
    ]
    return "\n\n".join(parts)


def described_names(module_name: str, names: list[str]) -> str:
    """A block for each name at the place where it is written: packages hand names on lazily, and Griffe reads files."""
    package = importlib.import_module(module_name)
    blocks = []
    for name in names:
        place = home(module_name, name)
        if inspect.ismodule(getattr(package, name)):
            blocks.append(f"::: {place}\n    options: {{members: false}}")
        else:
            blocks.append(f"::: {place}.{name}")
    return "\n\n".join(blocks)


def on_page_markdown(markdown: str, page: Any, **_: object) -> str:
    """Put the tables of names above what MkDocs makes of the docstrings, and the keys where a page asks for them."""
    if page.file.src_uri.startswith("recipes/keys/"):
        return re.sub(KEYS, lambda match: keys_of(match[1]), markdown, flags=re.M)
    if not page.file.src_uri.startswith("api/"):
        return markdown

    def block(found: re.Match[str]) -> str:
        names = exported(found[1], found[2])
        return (
            f"{names_tables(found[1], names)}\n\n{described_names(found[1], names)}"
        )

    return re.sub(BLOCK, block, markdown, flags=re.M)


@functools.cache
def types_of(command: str) -> dict[str, str]:
    """Key -> what may be put in, of a command."""
    hints = hints_of(
        importlib.import_module(f"sphericalvision.recipes.{command}").main.keys
    )
    words = {key: expected(hint) for key, hint in hints.items()}
    return {key: text for key, text in words.items() if text != "a value"}


def type_of(key: Key, path: Path) -> str:
    """What may be put in: from the command's types, or else as the default is."""
    if path.parent.name == "conf" and (words := types_of(path.stem).get(key.name)):
        return words
    value = (
        yaml.safe_load(key.value or "null")
        if not key.value.startswith(("$", "?"))
        else None
    )
    words = {
        bool: "true or false",
        int: "a whole number",
        float: "a number",
        str: "text",
        list: "a list",
        dict: "a table",
    }
    return words.get(type(value), "")


def keys_of(command: str) -> str:
    """Every key of a command, those of the groups' default files included; or every file of every group."""
    if command == "groups":
        return keys_of_groups()
    path = ROOT / "conf" / f"{command}.yaml"
    text = path.read_text()
    summary, _, example = " ".join(heading(text)).partition("   ")
    sections = [
        summary,
        f"```text\n{example.strip()}\n```" if example else "",
        keys_table(path),
    ]
    groups = re.findall(
        r"^ {2}- (\w+): (\w+)", text.partition("defaults:")[2], re.M
    )
    for group, default in groups:
        folder = ROOT / "conf" / group
        if folder.is_dir():
            sections.append(
                f"## `{group}=…` {{#{group}}}\n\n[All of its values](groups.md#{group})"
                + (
                    f"; by default `{default}`:"
                    if default != "null"
                    else "; none by default."
                )
            )
            file = folder / f"{default}.yaml"
            if file.exists():
                own = "@package _global_" in file.read_text()
                sections.append(keys_table(file, "" if own else f"{group}."))
    return "\n\n".join(filter(None, sections))


def keys_of_groups() -> str:
    """Every file of every group with its keys."""
    parts = []
    for folder in sorted(
        path for path in (ROOT / "conf").iterdir() if path.is_dir()
    ):
        files = sorted(folder.glob("*.yaml"))
        parts += [f"## `{folder.name}=…` {{#{folder.name}}}"] if files else []
        for path in files:
            text = path.read_text()
            parts += [f"### `{folder.name}={path.stem}`", " ".join(heading(text))]
            parents = re.findall(
                r"^ {2}- (\w+)\s*$", text.partition("defaults:")[2], re.M
            )
            if parents := [parent for parent in parents if parent != "_self_"]:
                parts.append(
                    f"As {', '.join(f'`{parent}`' for parent in parents)}, and:"
                )
            parts.append(keys_table(path))
    return "\n\n".join(parts)


def keys_table(path: Path, prefix: str = "") -> str:
    """The keys of a file, as the command line names them."""
    rows = [
        f"| `{prefix}{key.name}` | {cell(key.value)} | {type_of(key, path)} | {escaped(key.comment)} |"
        for key in read_keys(path.read_text())
        if (key.value or key.comment)
        and not re.search(r"^hydra\b|_partial_$", key.name)
    ]
    return (
        "| key | default | type | meaning |\n|---|---|---|---|\n" + "\n".join(rows)
        if rows
        else ""
    )


def cell(value: str) -> str:
    """A value in code, or nothing."""
    return f"`{escaped(value)}`" if value else ""


def escaped(text: str) -> str:
    """A text whose bars do not end the cell of a table."""
    return text.replace("|", "\\|")
