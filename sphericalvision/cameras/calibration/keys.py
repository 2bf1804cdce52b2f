# SPDX-License-Identifier: Apache-2.0
"""Keys of a file that remember whether they were read: what is left over does not matter, or is refused by name.

A key that is dropped may be the distortion under another name, a crop, or a turn of the image, and the camera without
it looks as good as with it. So a file is understood when each of its keys was read, or is known not to matter: by its
words, such as ``date`` or ``rms``, or by the list of its format.
"""

from __future__ import annotations

import re
from difflib import get_close_matches
from typing import Any

from sphericalvision.core import FileFormatError, short_repr

__all__ = ["SETTINGS", "Keys", "check_understood", "noted"]

_NEVER_MATTER = re.compile(
    "(time|date|stamp|timestamp|comment|note|description|author|error|rms|residual|board|square|marker|chessboard|charuco|aruco"
    "|covariance|std|deviation|uncertainty|header|seq|dt)s?"
)
"""One of these words in a key is enough."""
_SELDOM_MATTER = re.compile(
    "(name|id|serial|number|uuid|version|label|fps|rate|topic|exposure|gain|temperature|device|manufacturer)s?"
)
_MATTER = re.compile(
    "(distortion|dist|model|lens|projection|camera|type|matrix|intrinsic|extrinsic|rotation|translation|pose|transform"
    "|crop|roi|offset|binning|scale|size|width|height|mask|focal|center|unit)s?"
)
"""With one of these words a key may matter for all the others, except ``camera_name`` and the like."""
_NAMES = re.compile(r"(?i)(camera|cam|lens)_?(name|id|label|serial(_?(no|number))?)|type_id")

SETTINGS = "(?!(?i:crop|roi|binning|scale|resiz|downs|flip|rotat|undist))"
"""In front of the pattern of a program's settings, whatever they are called: none crops, scales or turns the image."""


class Keys(dict[Any, Any]):
    """A mapping of a file that remembers which keys were read, and which were asked for in vain."""

    def __init__(self) -> None:
        super().__init__()
        self.read: set[Any] = set()
        self.missed: set[str] = set()

    def __getitem__(self, key: Any) -> Any:
        value = super().__getitem__(key)
        self.read.add(key)
        return value

    def __contains__(self, key: Any) -> bool:
        found = super().__contains__(key)
        if not found:
            self.missed.add(str(key))
        return found

    def forget(self) -> None:
        """Take no notice of what was asked for so far."""
        self.read.clear()
        self.missed.clear()

    def get(self, key: Any, default: Any = None) -> Any:
        """The value of a key, which counts as read."""
        there = key in self
        return self[key] if there else default


def noted(value: Any, known: dict[int, Any] | None = None) -> Any:
    """What was parsed, with ``Keys`` in place of all mappings; what stands at two places stays one thing."""
    known = {} if known is None else known
    if not isinstance(value, dict | list) or id(value) in known:
        return known.get(id(value), value)
    if isinstance(value, dict):
        keys = known[id(value)] = Keys()
        for key, inner in value.items():
            dict.__setitem__(keys, key, noted(inner, known))
        return keys
    several: list[Any] = []
    known[id(value)] = several
    several.extend(noted(inner, known) for inner in value)
    return several


def check_understood(
    content: Any, where: str, ignored: str, way: str = "", lists: frozenset[int] = frozenset()
) -> None:
    """Raise for a key that was not read and may matter.

    Args:
        content: ``noted``, after it was read.
        where: the file, in errors.
        ignored: what does not matter in this format, as a regular expression for the whole way to a key, ``a/b`` being
            the key b in that of a; places in lists do not count.
        way: to ``content``.
        lists: those that ``content`` lies in: by aliases of YAML a list may hold itself.

    Raises:
        FileFormatError: there is one; the message names it.
    """
    if isinstance(content, list) and id(content) not in lists:
        for inner in content:
            check_understood(inner, where, ignored, way, lists | {id(content)})
    if not isinstance(content, Keys):
        return
    read, content.read = content.read, set(content)  # what stands at two places is looked at once
    for key, value in content.items():
        name = f"{way}{key}"
        if key in read:
            check_understood(value, where, ignored, f"{name}/", lists)
        elif similar := get_close_matches(str(key), content.missed - set(content), 1, 0.85):
            raise FileFormatError(
                f"{where}: the key {short_repr(name)} is not known; correct it to {similar[0]!r}, or remove it"
            )
        elif not (re.fullmatch(ignored, name) or _never_matters(str(key))):
            raise FileFormatError(
                f"{where}: the key {short_repr(name)} is not understood here, and the camera may be another one with "
                "it; correct its name, or remove it if it does not matter"
            )


def _never_matters(key: str) -> bool:
    if key.startswith("_"):  # how a comment is written in JSON, which has none
        return True
    words = [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", key)]
    if any(map(_NEVER_MATTER.fullmatch, words)) or _NAMES.fullmatch(key):
        return True
    return any(map(_SELDOM_MATTER.fullmatch, words)) and not any(map(_MATTER.fullmatch, words))
