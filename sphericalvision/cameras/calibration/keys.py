# SPDX-License-Identifier: Apache-2.0
"""Keys of a file that know where they stand there, check their values, and remember whether they were read.

Errors name file, place and key, ``camchain.yaml, cam0, resolution``. What is left over does not matter, or is refused
by name. A key that is dropped may be the distortion under another name, a crop, or a turn of the image, and the camera
without it looks as good as with it. So a file is understood when each of its keys was read, or is known not to matter:
by its words, such as ``date`` or ``rms``, or by the list of its format.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.calibration.parsing import (
    chosen,
    chosen_model,
    matrix,
    numbers,
    size_from_width_height,
)
from sphericalvision.cameras.calibration.poses import transform_from_rows
from sphericalvision.core import FileFormatError, short_repr
from sphericalvision.io.times import SAME_TIME, unit_in

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

_SETS = re.compile(
    r"(?i)\w*(time_?stamp|stamp|uuid|session|recording|serial(_?(no|number))?|(group|component|rig|device)(_?id)?)\w*|time"
)
"""Identifiers by which the entries of one list may be of several sets."""

_DELAY = re.compile(r"(?i)[\w-]*time(stamp)?[_-]?(shift|offset|delay)[\w-]*")
"""How formats call the seconds, or nanoseconds, by which the clock of a camera differs from that of the device."""

SETTINGS = "(?!(?i:crop|roi|binning|scale|resiz|downs|flip|rotat|undist))"
"""In front of the pattern of a program's settings, whatever they are called: none crops, scales or turns the image."""


class Keys(dict[Any, Any]):
    """A mapping of a file. All of its methods raise ``FileFormatError`` for what is not there or makes no sense.

    Attributes:
        where: the file and the place of the mapping in it, in errors.
        read: keys that were read.
        missed: keys that were asked for in vain.
    """

    def __init__(self, where: str = "") -> None:
        super().__init__()
        self.where = where
        self.read: set[Any] = set()
        self.missed: set[str] = set()

    def __getitem__(self, key: Any) -> Any:
        value = super().__getitem__(key)
        self.read.add(key)
        return value

    def __contains__(self, key: Any) -> bool:
        exists = super().__contains__(key)
        if not exists:
            self.missed.add(str(key))
        return exists

    def forget(self) -> None:
        """Take no notice of what was asked for so far."""
        self.read.clear()
        self.missed.clear()

    def at(self, *keys: str) -> str:
        """Where keys stand, in errors."""
        return f"{self.where}, {' and '.join(keys)}"

    def get(self, key: Any, default: Any = None) -> Any:
        """The value of a key, which counts as read."""
        exists = key in self
        return self[key] if exists else default

    def entry(self, key: str) -> Any:
        """The value of a key that must be there."""
        if key not in self:
            raise FileFormatError(
                f"{self.where}: the key {key!r} is missing; found {', '.join(map(str, self)) or 'none'}"
            )
        return self[key]

    def inner(self, key: str) -> Keys:
        """The mapping under a key."""
        return as_keys(self.entry(key), self.at(key))

    def several(self, key: str) -> list[Keys]:
        """The mappings of a list, at least one."""
        values = self.entry(key)
        if not isinstance(values, list) or not values:
            raise FileFormatError(
                f"{self.at(key)}: expected a list of at least one entry, got {short_repr(values)}"
            )
        return [as_keys(value, f"{self.at(key)}[{index}]") for index, value in enumerate(values)]

    def number(self, key: str, default: float | None = None) -> float:
        """The finite number under a key, which must be there unless there is a ``default``."""
        if default is not None and key not in self:
            return default
        return numbers(self.entry(key), self.at(key), 1)[0]

    def half_view(self, key: str) -> float | None:
        """Radians from the axis, of a full angle in degrees; None where the key is not there."""
        if self.get(key) is None:
            return None
        view = self.number(key)
        if not 2 * math.pi < view <= 360:
            raise FileFormatError(
                f"{self.at(key)}: expected degrees up to 360, got {view:g}; are these radians?"
            )
        return math.radians(view) / 2

    def count(self, key: str, most: int, default: float | None = None) -> int:
        """A whole number from 1 to ``most``."""
        number = self.number(key, default)
        if number != int(number) or not 1 <= number <= most:
            raise FileFormatError(f"{self.at(key)}: expected a count from 1 to {most}, got {number:g}")
        return int(number)

    def numbers(self, key: str, count: int | None = None) -> list[float]:
        """A list of finite numbers."""
        return numbers(self.entry(key), self.at(key), count)

    def matrix(self, key: str, count: int | None = None) -> list[float]:
        """The numbers of a matrix, row by row, as ``parsing.matrix`` has them."""
        return matrix(self.entry(key), self.at(key), count)

    def coefficients(self, key: str, count: int) -> list[float]:
        """So many coefficients of a distortion, behind which zeros may stand; of none the key may be missing."""
        values = self.get(key) if count == 0 else self.entry(key)
        coefficients = numbers(values, self.at(key)) if values or count else []
        if any(coefficients[count:]) or len(coefficients) < count:
            raise FileFormatError(
                f"{self.at(key)}: expected {count or 'no'} coefficients of the distortion_model, got "
                f"{short_repr(values)}"
            )
        return coefficients[:count]

    def pose(self, key: str) -> Float[Tensor, "4 4"]:
        """A rigid transform (4, 4), float64, of 4 or 3 rows of 4 numbers, as ``transform_from_rows`` has them."""
        value, where = self.entry(key), self.at(key)
        return transform_from_rows(matrix(value, where) if isinstance(value, Keys) else value, where)

    def size(self, *keys: str) -> tuple[int, int]:
        """(height, width) of an image, from the keys of width and height, or the one of both."""
        sides = [self.entry(key) for key in keys]
        return size_from_width_height(sides if len(keys) > 1 else sides[0], self.at(*keys))

    def chosen(self, key: str, choices: Iterable[str], default: str | None = None) -> str:
        """One of the words ``choices``, or ``default`` where the key is not there."""
        return chosen(self.entry(key) if default is None else self.get(key, default), choices, self.at(key))

    def model(self, key: str, choices: Iterable[str], default: str | None = None) -> str:
        """The one of a format's names of models that is meant, or ``default`` where the key is not there."""
        value = self.entry(key) if default is None else self.get(key, default)
        return chosen_model(value, choices, self.at(key))


def as_keys(value: Any, where: str) -> Keys:
    """``value`` if it is a mapping of a file, else ``FileFormatError``; ``where`` names the place in it."""
    if not isinstance(value, Keys):
        kind = f"a list of {len(value)}; keep one" if isinstance(value, list) else type(value).__name__
        raise FileFormatError(f"{where}: expected keys with values, got {kind}")
    return value


def with_keys(value: Any, where: str) -> Any:
    """A parsed value, with ``Keys`` in place of all plain mappings."""
    if isinstance(value, dict) and not isinstance(value, Keys):
        keys = Keys(where)
        for key, inner in value.items():
            dict.__setitem__(keys, key, with_keys(inner, f"{where}, {key!s:.80}"))
        return keys
    if isinstance(value, list):  # most are lists of numbers, which need no names
        return [
            inner if isinstance(inner, int | float) else with_keys(inner, f"{where}[{index}]")
            for index, inner in enumerate(value)
        ]
    return value


def check_understood(content: Any, where: str, ignored: str, way: str = "") -> None:
    """Raise for a key that was not read and may matter.

    Args:
        content: ``with_keys``, after it was read.
        where: the file, in errors.
        ignored: what does not matter in this format, as a regular expression for the whole way to a key, ``a/b`` being
            the key b in that of a; places in lists do not count.
        way: to ``content``.
    """
    if isinstance(content, list | dict):
        values = content.values() if isinstance(content, dict) else content
        entries = [inner for inner in values if isinstance(inner, Keys)]
        _check_clocks(entries, where)
    if isinstance(content, list):
        for key in dict.fromkeys(key for entry in entries for key in entry if key not in entry.read):
            if _SETS.fullmatch(str(key)):
                check_one_set(
                    key, [dict.get(entry, key) for entry in entries if dict.__contains__(entry, key)], where
                )
        for inner in content:
            check_understood(inner, where, ignored, way)
    if not isinstance(content, Keys):
        return
    for key, value in content.items():
        name = f"{way}{key}"
        if key in content.read:
            check_understood(value, where, ignored, f"{name}/")
        elif similar := get_close_matches(str(key), content.missed - set(content), 1, 0.85):
            raise FileFormatError(
                f"{where}: the key {short_repr(name)} is not known; correct it to {similar[0]!r}, or remove it"
            )
        elif not (re.fullmatch(ignored, name) or _never_matters(str(key))):
            raise FileFormatError(
                f"{where}: the key {short_repr(name)} is not understood here, and the camera may be another one with "
                "it; correct its name, or remove it if it does not matter"
            )


def _check_clocks(entries: list[Keys], where: str) -> None:
    """Warn of cameras whose clocks differ, by as much as keeps their images apart."""
    for key in dict.fromkeys(key for entry in entries for key in entry if _DELAY.fullmatch(str(key))):
        unit = unit_in(key) or 1.0
        delays = {
            entry.at(key): unit * entry.number(key) for entry in entries if dict.__contains__(entry, key)
        }
        slow, fast = (choose(delays, key=delays.__getitem__) for choose in (min, max))
        if (gap := delays[fast] - delays[slow]) > SAME_TIME:
            warnings.warn(
                f"{where}: the clocks of two cameras are {gap:.3g} s apart ({slow}, and {fast}); images are paired by "
                "times as they are: correct these, or the calibration",
                stacklevel=6,
            )


def check_one_set(key: str, values: Iterable[Any], where: str) -> None:
    """Refuse entries that an identifier splits into several sets: cameras of two moments or devices are no rig.

    Identifiers that all differ name the entries, as the times of a camera that moves do.

    Args:
        key: of the identifier.
        values: of the entries that have it.
        where: the file, in errors.
    """
    texts = list(map(str, values))
    if 1 < len(set(texts)) < len(texts):
        raise FileFormatError(
            f"{where}: the entries have {len(set(texts))} values of {key!r} ({short_repr(sorted(set(texts)))}), "
            "as of several moments or devices; keep those of one"
        )


def _never_matters(key: str) -> bool:
    if key.startswith("_"):  # how a comment is written in JSON, which has none
        return True
    tokens = [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", key)]
    if any(map(_NEVER_MATTER.fullmatch, tokens)) or _NAMES.fullmatch(key):
        return True
    return any(map(_SELDOM_MATTER.fullmatch, tokens)) and not any(map(_MATTER.fullmatch, tokens))
