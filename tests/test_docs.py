# SPDX-License-Identifier: Apache-2.0
"""The documentation can be read: every page is found, every link leads somewhere, every block fits."""

import inspect
import os
import re
import subprocess
import sys
import textwrap
from importlib import import_module
from pathlib import Path

import pytest

from tests.documented import FENCE, PAGES, ROOT, blocks

BLOCK_WIDTH = 84
"""Letters of a line of code that a window of 1280 pixels shows."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_blocks_of_a_page_fit_into_a_window(page: Path) -> None:
    lines = "\n".join(block.body for block in blocks(page, visible=True)).splitlines()
    assert not [line for line in lines if len(line) > BLOCK_WIDTH]


def test_shapes_in_docstrings_are_no_emphasis(monkeypatch: pytest.MonkeyPatch) -> None:
    """Markdown takes "(*, 3) of points (*, 3)" for emphasis, and its stars are gone."""
    convert = pytest.importorskip("markdown").Markdown().convert
    pytest.importorskip("griffe")
    monkeypatch.syspath_prepend(ROOT / "docs")
    import docstrings

    def eaten(text: str) -> bool:
        parts = re.split(r"\n\s*\n|\n(?=\s+\w+: )", text)
        return any("(*" in p and re.search("<(em|strong)>[,) ]", convert(inspect.cleandoc(p))) for p in parts)

    assert eaten("Pixels (*, 2) of ``points`` (*, 3).")
    for file in (ROOT / "sphericalvision").rglob("*.py"):
        for doc in re.findall(r'"""(.*?)"""', file.read_text(), re.DOTALL):
            assert not eaten(docstrings.as_code(doc.partition("Examples:")[0])), (file, doc)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_lists_in_command_lines_are_quoted(page: Path) -> None:
    """Zsh takes brackets for a pattern of files, and finds none."""
    inline = re.findall(r"`((?:sphericalvision-|python )[^`]*=[^`]*)`", FENCE.sub("", page.read_text()))
    for script in [*(block.body for block in blocks(page, "bash", "text")), *inline]:
        lines = re.sub(r"'[^']*'|\"[^\"]*\"|#.*", "", script).splitlines()
        assert not [line for line in lines if re.search(r"=\[", line)]


@pytest.mark.usefixtures("copied_registries")
def test_examples_of_the_api_begin_with_their_imports(monkeypatch: pytest.MonkeyPatch) -> None:
    """A page shows an example as a program: each name is imported or bound by it, and each import is right."""
    pytest.importorskip("griffe")
    monkeypatch.syspath_prepend(ROOT / "docs")
    import docstrings

    programs = 0
    for package in docstrings.PACKAGES:
        for name in import_module(package).__all__:
            value = getattr(import_module(package), name)
            if not (inspect.isclass(value) or inspect.isfunction(value)) or ">>>" not in (
                value.__doc__ or ""
            ):
                continue
            text = docstrings.with_programs(inspect.cleandoc(value.__doc__), import_module(value.__module__))
            program = re.search(r"```python\n(.*?)```", text, re.DOTALL)
            assert program is not None, name
            source = textwrap.dedent(program[1])
            assert not docstrings.used_names(source), name
            imports = [line for line in source.splitlines() if re.match(r"(from \S+ )?import ", line)]
            exec("\n".join(imports), {})
            programs += 1
    assert programs > 200


def test_cameras_are_shown_with_their_own_constructor(monkeypatch: pytest.MonkeyPatch) -> None:
    griffe = pytest.importorskip("griffe")
    monkeypatch.syspath_prepend(ROOT / "docs")
    extensions = griffe.load_extensions(ROOT / "docs" / "docstrings.py:Docstrings")
    shown = griffe.load(
        "sphericalvision.cameras.models.double_sphere", search_paths=[ROOT], extensions=extensions
    )
    camera = shown["DoubleSphereCamera"]
    names = [parameter.name for parameter in camera.parameters]
    assert names == ["self", *inspect.signature(import_module(shown.path).DoubleSphereCamera).parameters]
    assert "focal_length: ``(*, 2)``, (fx, fy), pixels, above 0." in camera.docstring.value


def test_programs_of_a_page_share_a_session_and_fail_as_a_whole(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pytest.importorskip("markdown_exec")
    monkeypatch.syspath_prepend(ROOT / "docs")
    monkeypatch.chdir(tmp_path)
    import programs

    fence = '```python exec="true" session="a"\n'
    text = f'{fence}x = 1\n```\n{fence}print(x, 2, sep="-")\n```\n'
    assert programs.outputs(text) == {("a", "x = 1"): "", ("a", 'print(x, 2, sep="-")'): "1-2\n"}
    assert programs.outputs(text.replace("x = 1", "y = 1")) == {}


def test_every_page_is_in_the_navigation() -> None:
    """No page is written and then forgotten."""
    listed = set(re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE))
    assert listed == {page.relative_to(ROOT / "docs").as_posix() for page in (ROOT / "docs").rglob("*.md")}


def test_relative_links_lead_to_files() -> None:
    broken = []
    for page in PAGES:
        for target in re.findall(r"\]\((?!https?:|mailto:|#)([^)#\s]+)", page.read_text()):
            if not (page.parent / target).exists():
                broken.append(f"{page.relative_to(ROOT)}: {target}")
    assert not broken, broken


def test_every_page_is_two_links_away_from_the_first() -> None:
    """By links in texts, not in the navigation alone; the first page is the README."""
    docs = ROOT / "docs"
    reached = latest = {ROOT / "README.md"}
    for _ in range(3):
        texts = ((page, FENCE.sub("", page.read_text())) for page in latest)
        targets = (
            (page.parent / target).resolve()
            for page, text in texts
            for target in re.findall(r"\]\((?!https?:|mailto:|#)([^)#\s]+\.md)", text)
        )
        latest = {*targets} - reached
        reached = reached | latest
    pages = {page for page in docs.rglob("*.md") if "<!-- page: " not in page.read_text()}
    assert {page.relative_to(docs).as_posix() for page in pages - reached} == set()


def test_every_public_name_is_on_one_page_of_the_api(monkeypatch: pytest.MonkeyPatch) -> None:
    """Packages that are described in parts: no part may be forgotten."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    import reference_pages

    pages = (page.read_text() for page in (ROOT / "docs" / "api").glob("*.md"))
    parts = [part for page in pages for part in re.findall(reference_pages.BLOCK, page, re.M)]
    for package in {package for package, homes in parts if homes}:
        shown = [name for of, homes in parts if of == package for name in reference_pages.exported(of, homes)]
        assert sorted(shown) == sorted(reference_pages.exported(package)), package


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    """``make docs``: every name of the API is found, and every link inside a page leads somewhere."""
    pytest.importorskip("mkdocs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    result = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
    assert 'id="sphericalvision.cameras.rig.CameraRig"' in (tmp_path / "api" / "rigs.html").read_text()
