# SPDX-License-Identifier: Apache-2.0
"""Comments of tables and clouds that contradict how these are read, such as positions in millimetres."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path

METRES = {
    r"(^|\bunits?\b|\b(in|are)\b|[\[(=:])\W*([cmk]m|(centi|milli|kilo)met(er|re)s?|feet|ft|inch(es)?)\b": "metres",
    r"\b(lat|latitude)\b": "x, y and z in metres",
}
"""Units that a comment may name, and the expected ones."""
FIRST = 100
"""Lines of a file among which comments are looked at, of so many characters at most."""


def warn_of_comments(path: Path, lines: Iterable[str], expected: Mapping[str, str] = METRES) -> None:
    """Warn of the first comment that contradicts what is expected; values are taken as expected nevertheless.

    Args:
        path: of the file, for the message.
        lines: from its beginning, of text; ``#``, ``//``, ``%`` and ``comment`` and ``obj_info`` begin a comment.
        expected: regular expression of a contradicting comment -> what is expected instead.
    """
    for number, line in zip(range(1, FIRST + 1), lines, strict=False):
        match = re.match(r"[^#/%]*(?:#|//|%)(.*)|(?:comment|obj_info)\b(.*)", line[:FIRST])
        comment = (match[1] or match[2] or "").strip() if match else ""
        for pattern, convention in expected.items():
            if re.search(pattern, comment, re.IGNORECASE):
                warnings.warn(
                    f"{path}, line {number}: expected {convention}, the comment says {comment!r}; the values are taken "
                    "as expected: correct them, or the comment",
                    stacklevel=4,
                )
                return
