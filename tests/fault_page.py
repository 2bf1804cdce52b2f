# SPDX-License-Identifier: Apache-2.0
"""The page that shows what is said when something is wrong: made by doing it all wrong.

``python -m tests.fault_page`` writes ``docs/faults.md``; `tests/test_fault_page.py` compares it with what is said now.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import tempfile
from pathlib import Path

from sphericalvision.cameras import ring_rig, save_rig
from sphericalvision.core import SphericalVisionError
from tests.recipes.conftest import run_recipe
from tests.recipes.test_faults import FAULTS
from tests.test_misuse import MISUSES

__all__ = ["PAGE", "page"]

PAGE = Path(__file__).resolve().parents[1] / "docs" / "faults.md"
OF_THE_MACHINE = ("an unknown device",)
"""Misuses whose message says what this machine has."""

HEAD = """# What is said when something is wrong

Every line here is done by a test, and what is said is what it said (`tests/fault_page.py` writes this page). On the
command line it is one paragraph and status 1; in Python a `SphericalVisionError` that is also the built-in error one
would expect.

## On the command line

| command | what is said |
|---|---|
"""
MIDDLE = """
## In Python

| what | what is said |
|---|---|
"""


def page() -> str:
    """The whole page."""
    lines = [HEAD]
    lines += [f"| `{command}` | {text(message)} |\n" for command, message in said_by_commands()]
    lines.append(MIDDLE)
    lines += [f"| {name} | {text(message)} |\n" for name, message in said_in_python()]
    return "".join(lines)


def said_by_commands() -> list[tuple[str, str]]:
    """Command lines and what they print on stderr, in the order of the table."""
    found = []
    for recipe, words, _ in FAULTS:
        with tempfile.TemporaryDirectory() as folder:
            save_rig(ring_rig(4, 0.2, (32, 32)), Path(folder) / "capture/config.yaml")
            printed = io.StringIO()
            with (
                contextlib.redirect_stderr(printed),
                contextlib.redirect_stdout(io.StringIO()),
                contextlib.suppress(SystemExit),
            ):
                run_recipe(Path(folder), recipe, *words.split())
            message = printed.getvalue().partition("Error: ")[2].replace(os.path.realpath(folder), "HERE")
            message = message.replace(folder, "HERE").replace("HERE/", "").replace("HERE", "this folder")
            found.append((f"sphericalvision-{recipe} {words}".strip(), message))
    return found


def said_in_python() -> list[tuple[str, str]]:
    """Misuses of the library and the messages of their errors."""
    found = []
    for name, (call, _, _) in MISUSES.items():
        if name in OF_THE_MACHINE:
            continue
        try:
            call()
        except SphericalVisionError as error:
            found.append((name, str(error)))
    return found


def text(message: str) -> str:
    """A message as a cell of a table."""
    plain = re.sub(r"\s+", " ", message).strip()
    return re.sub(r"([|<>*_`\[\]{}\\])", r"\\\1", plain)


if __name__ == "__main__":
    PAGE.write_text(page())
