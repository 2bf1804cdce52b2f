# SPDX-License-Identifier: Apache-2.0
"""The documentation is true: its Python runs, and its command lines are understood by the recipes."""

from __future__ import annotations

import importlib
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra

from sphericalvision.recipes.app.words import quote_paths

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(
    r"^(?P<indent> *)```(?P<info>[^\n`]+)\n(?P<body>.*?)^(?P=indent)```", re.DOTALL | re.MULTILINE
)


def blocks(page: Path, language: str) -> Iterator[str]:
    """Bodies of the fenced blocks of one language."""
    for match in FENCE.finditer(page.read_text()):
        if match["info"].split()[0] == language:
            indent = len(match["indent"])
            yield "\n".join(line[indent:] for line in match["body"].splitlines())


def commands() -> list[tuple[str, str]]:
    """Every `sphericalvision-*` command line of every page, continuation lines joined."""
    found = []
    for page in PAGES:
        for block in blocks(page, "bash"):
            for line in block.replace("\\\n", " ").splitlines():
                if line.strip().startswith("sphericalvision-"):
                    found.append((page.relative_to(ROOT).as_posix(), " ".join(line.split())))
    return found


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if next(blocks(page, "python"), None) is not None],
    ids=lambda page: page.relative_to(ROOT).as_posix(),
)
def test_python_of_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The blocks of a page are one program, read from top to bottom."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(ROOT / "docs")  # as MkDocs does for the pages' helper
    namespace: dict[str, object] = {"__name__": "page"}
    for number, source in enumerate(blocks(page, "python"), start=1):
        exec(compile(source, f"{page.name}, block {number}", "exec"), namespace)


@pytest.mark.parametrize(("page", "command"), commands())
def test_command_line_is_understood(page: str, command: str) -> None:
    """Every `key=value` of a printed command is a key of that recipe's configuration."""
    program, *arguments = shlex.split(command, comments=True)
    name = program.removeprefix("sphericalvision-")
    importlib.import_module(f"sphericalvision.recipes.{name}")
    words = quote_paths(arguments)
    overrides = [word for word in words if "=" in word and not word.startswith("-")]
    if "--multirun" in arguments:  # a sweep is checked at the first value of each key
        overrides = [override.split(",")[0] for override in overrides]
    GlobalHydra.instance().clear()
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        compose(name, overrides=overrides)


def test_every_page_is_in_the_navigation() -> None:
    """No page is written and then forgotten."""
    text = re.sub(r"!!python/\S+", "", (ROOT / "mkdocs.yml").read_text())
    listed: set[str] = set()

    def walk(node: object) -> None:
        if isinstance(node, str):
            listed.add(node)
        elif isinstance(node, dict):
            for value in node.values():
                walk(value)
        elif isinstance(node, list):
            for value in node:
                walk(value)

    walk(yaml.safe_load(text)["nav"])
    assert listed == {page.relative_to(ROOT / "docs").as_posix() for page in (ROOT / "docs").rglob("*.md")}


def test_relative_links_lead_to_files() -> None:
    broken = []
    for page in PAGES:
        for target in re.findall(r"\]\((?!https?:|mailto:|#)([^)#\s]+)", page.read_text()):
            if not (page.parent / target).exists():
                broken.append(f"{page.relative_to(ROOT)}: {target}")
    assert not broken, broken
