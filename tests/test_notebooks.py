# SPDX-License-Identifier: Apache-2.0
"""The tutorials as notebooks: all of their Python is there, and runs where IPython shows the pictures."""

import sys
from pathlib import Path
from types import ModuleType

import pytest

from tests.documented import ROOT, blocks

pytest.importorskip("jupytext")
sys.path.append(str(ROOT / "docs"))
notebooks = pytest.importorskip("notebooks")

PAGES = sorted((ROOT / "docs" / "tutorials").glob("*.md"))


def code_of(page: Path) -> list[str]:
    return [cell.source for cell in notebooks.notebook(page).cells if cell.cell_type == "code"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_notebook_has_the_code_of_the_page(page: Path) -> None:
    cells = code_of(page)
    assert len(cells) == len(list(blocks(page, "python")))
    for number, source in enumerate(cells):
        compile(source, f"{page.stem}, cell {number}", "exec")
        assert not source.startswith("%")
        assert "from shown" not in source


@pytest.mark.slow
def test_notebook_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = []
    display = ModuleType("IPython.display")
    display.Image = lambda data, alt: data  # type: ignore[attr-defined]
    display.display = shown.append  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "IPython", ModuleType("IPython"))
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    namespace: dict[str, object] = {"__name__": "notebook"}
    for source in code_of(ROOT / "docs" / "tutorials" / "sweep-by-hand.md"):
        exec(compile(source, "sweep by hand", "exec"), namespace)
    assert len(shown) == 5
    assert all(picture.startswith(b"\x89PNG") for picture in shown)
