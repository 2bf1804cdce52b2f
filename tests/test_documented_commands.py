# SPDX-License-Identifier: Apache-2.0
"""Every command line in the documentation does what it says: all of a page, from top to bottom, in one folder."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.documented import (
    PAGES,
    ROOT,
    blocks,
    commands_of,
    composed,
    furnish,
    mentioned_in,
    run_command,
    write_files_of,
)

QUICK = ("docs/guide/which-camera.md", "docs/guide/sweep.md")
"""Pages whose commands take a second or two; the others are tried by `make test-all`."""

WITH_COMMANDS = [page for page in PAGES if commands_of(page)]


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where rendered scenes are kept for all pages."""
    return tmp_path_factory.mktemp("scenes")


@pytest.fixture(scope="module")
def furnished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with everything that pages name, which each page gets a copy of."""
    folder = tmp_path_factory.mktemp("furnished")
    furnish(folder)
    return folder


def name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@pytest.mark.parametrize(
    "page",
    [pytest.param(p, id=name(p), marks=[pytest.mark.slow] * (name(p) not in QUICK)) for p in WITH_COMMANDS],
)
def test_the_commands_of_a_page_run(
    page: Path, tmp_path: Path, cache: Path, furnished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(furnished, tmp_path, dirs_exist_ok=True)
    write_files_of(page, tmp_path)
    for command in commands_of(page):
        try:
            run_command(command, tmp_path, cache)
        except SystemExit as stopped:
            if stopped.code not in (0, None):
                pytest.fail(f"{command}: status {stopped.code}, {capsys.readouterr().err}")


@pytest.mark.parametrize("page", WITH_COMMANDS, ids=name)
def test_the_commands_of_a_page_are_understood(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every word is a key or option of its command: cheap, for all pages."""
    monkeypatch.chdir(tmp_path)
    write_files_of(page, tmp_path)
    for command in commands_of(page):
        composed(command.recipe, command.words)


MENTIONED = [page for page in [*PAGES, *sorted((ROOT / "conf").rglob("*.yaml"))] if mentioned_in(page)]


@pytest.mark.parametrize("page", MENTIONED, ids=name)
def test_the_commands_within_sentences_are_understood(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_files_of(ROOT / "docs/recipes/configuration.md", tmp_path)
    for command in mentioned_in(page):
        composed(command.recipe, command.words, whole=False)


def test_every_command_line_in_the_documentation_is_found() -> None:
    """A line in another kind of block would never be tried; only those of a package of one's own are."""
    for page in PAGES:
        if name(page) != "docs/recipes/plugin.md":
            for language in ("text", "console", "shell", "sh"):
                for _, block in blocks(page, language):
                    assert not [
                        x for x in block.splitlines() if x.startswith(("sphericalvision-", "python -m"))
                    ]
