# SPDX-License-Identifier: Apache-2.0
"""Shapes in docstrings, as in "points (*, 3)", are code in the API's pages: Markdown takes two stars for emphasis."""

from __future__ import annotations

import re

import griffe

SHAPE = re.compile(r"(?<![\w`])\(\*\w*(?:, [^()`]*)?\)")
"""A shape whose first size is any number of sizes; no call."""


def as_code(text: str) -> str:
    """Put the shapes of a docstring into backticks, but for those in code and in examples."""
    lines = []
    for line in text.split("\n"):
        if not re.match(r"\s*(>>>|\.\.\.)", line):
            parts = re.split(r"(`+[^`]*`+)", line)
            line = "".join(
                part if part.startswith("`") else SHAPE.sub(r"``\g<0>``", part)
                for part in parts
            )
        lines.append(line)
    return "\n".join(lines)


class Shapes(griffe.Extension):
    """What Griffe calls for each object that it reads."""

    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        """Rewrite its docstring."""
        if obj.docstring:
            obj.docstring.value = as_code(obj.docstring.value)
