# SPDX-License-Identifier: Apache-2.0
"""docs/conventions.md and the tests agree: each convention names its test, each such test is on the page."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def on_the_page() -> dict[str, list[str]]:
    """Tests named under each heading of the page."""
    page = (ROOT / "docs" / "conventions.md").read_text()
    sections = re.split(r"^## ", page, flags=re.MULTILINE)[1:]
    return {text.splitlines()[0]: re.findall(r"`(test_convention_\w+)`", text) for text in sections}


def in_the_tests() -> set[str]:
    found: set[str] = set()
    for path in (ROOT / "tests").rglob("test_*.py"):
        found.update(re.findall(r"^ *def (test_convention_\w+)", path.read_text(), flags=re.MULTILINE))
    return found


def test_every_convention_names_its_test() -> None:
    without = [heading for heading, names in on_the_page().items() if not names]
    assert not without, f"docs/conventions.md: no test_convention_* named under {without}"


def test_page_and_tests_name_the_same_conventions() -> None:
    page = {name for names in on_the_page().values() for name in names}
    assert page == in_the_tests()
