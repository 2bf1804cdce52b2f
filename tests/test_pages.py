# SPDX-License-Identifier: Apache-2.0
"""Every page can be followed: its blocks are pasted one after the other into a folder, and each has a result."""

import ast
import re
import shutil
import time
from pathlib import Path

import pytest
import torch

from tests.documented import (
    PAGES,
    ROOT,
    Block,
    Command,
    blocks,
    bring,
    commands_of,
    composed,
    mentioned_in,
    run_command,
)

QUICK = ("README.md", "docs/guide/which-camera.md")
"""Pages whose commands take a second or two; those of the others are run by `make test-all`."""
LONG = (
    "docs/guide/predictor.md",
    "docs/tutorials/360-camera.md",
    "docs/tutorials/moving-camera.md",
    "docs/tutorials/segmentation.md",
)
"""Pages whose Python takes five to ten seconds: the quick tests run what it imports."""
STAGED = ["experiment=refinedsweepnet"]
"""A training in stages, each of another network: tests/recipes/test_stages.py runs it."""
WRITTEN = re.compile(r'(?:write_image|save\w*|export)\("([\w./]+\.\w+)"')
"""A file that Python writes under a name that the page shows."""


def name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def is_run(page: Path) -> bool:
    """Whether a page has more to run than Python that takes a second."""
    return name(page) in LONG or any(commands_of(block.body) for block in blocks(page, "bash"))


PASTED = [page for page in PAGES if any(blocks(page, "python", visible=True)) or is_run(page)]


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where rendered scenes are kept for all pages."""
    return tmp_path_factory.mktemp("scenes")


@pytest.fixture(scope="module")
def brought(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what a reader brings, which each page gets a copy of."""
    folder = tmp_path_factory.mktemp("brought")
    bring(folder)
    return folder


def paste(page: Path, folder: Path, cache: Path | None = None) -> None:
    """Each block after the ones before it. Without a cache of scenes, commands and long programs are only read."""
    torch.manual_seed(0)  # pages draw random images
    session: dict[str, object] = {"__name__": "page"}
    for number, block in enumerate(blocks(page, visible=True), start=1):
        if block.title:
            write_file(block, folder)
        elif block.language == "python":
            program = ast.parse(block.body)
            if only_imports := cache is None and name(page) in LONG:
                program.body = [x for x in program.body if isinstance(x, ast.Import | ast.ImportFrom)]
            exec(compile(program, f"{page.name}, block {number}", "exec"), session)
            files = [] if only_imports else WRITTEN.findall(re.sub(r"#.*", "", block.body))
            assert not [file for file in files if not (folder / file).is_file()]
        elif block.language == "bash":
            for command in commands_of(block.body):
                if cache is None or command.words == STAGED:
                    composed(command.recipe, command.words)
                else:
                    run(command, folder, cache)


def write_file(block: Block, folder: Path) -> None:
    """The file that a page shows with its name."""
    path = folder / block.title
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(block.body + "\n")


def run(command: Command, folder: Path, cache: Path) -> None:
    """A command ends well and leaves a file, but for what may print alone."""
    start = time.time() - 0.1  # clocks of files are coarse
    try:
        run_command(command, folder, cache)
    except SystemExit as stopped:
        if stopped.code not in (0, None):
            pytest.fail(f"{command}: status {stopped.code}")
    files = (path for path in folder.rglob("*") if path.is_file() and path.stat().st_mtime > start)
    prints = command.recipe in ("align", "convert") or "--cfg" in command.words
    assert prints or any(files), command


@pytest.mark.usefixtures("copied_registries")
@pytest.mark.parametrize("page", [page for page in PASTED if name(page) not in QUICK], ids=name)
def test_a_page_is_understood(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its Python runs in an empty folder, as one program, and each word of its commands is a key or an option."""
    monkeypatch.chdir(tmp_path)
    paste(page, tmp_path)


@pytest.mark.usefixtures("copied_registries")
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=name(page), marks=[pytest.mark.slow] * (name(page) not in QUICK))
        for page in filter(is_run, PASTED)
    ],
)
def test_a_page_works(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cache: Path, brought: Path
) -> None:
    """All of it runs, from top to bottom, with what no page can make for its reader."""
    shutil.copytree(brought, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    paste(page, tmp_path, cache)


MENTIONED = [page for page in [*PAGES, *sorted((ROOT / "conf").rglob("*.yaml"))] if mentioned_in(page)]


@pytest.mark.parametrize("page", MENTIONED, ids=name)
def test_the_commands_within_sentences_are_understood(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for block in blocks(ROOT / "docs/recipes/configuration.md", "yaml", "python"):
        if block.title:
            write_file(block, tmp_path)
    for command in mentioned_in(page):
        composed(command.recipe, command.words, whole=False)


def test_every_command_line_in_the_documentation_is_found() -> None:
    """A line in another kind of block would never be tried; only those of a package of one's own are."""
    for page in PAGES:
        if name(page) != "docs/recipes/plugin.md":
            for block in blocks(page, "text", "console", "shell", "sh"):
                lines = block.body.splitlines()
                assert not [x for x in lines if x.startswith(("sphericalvision-", "python -m"))]
