# SPDX-License-Identifier: Apache-2.0
"""Kinds of values that configurations have, as type hints: of the commands' keys, and of what configurations name."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, MinLen
from pydantic import ConfigDict, Field, Strict

__all__ = [
    "STRICT",
    "Count",
    "Device",
    "Distance",
    "FullAngle",
    "HalfAngle",
    "Names",
    "Number",
    "OnlyWith",
    "Positive",
    "Share",
    "Size",
    "Text",
    "Unit",
]

STRICT = ConfigDict(strict=True)
"""Of dataclasses of keys: types are exact, no text for a number, no truth value for a whole number."""

Count = Annotated[int, Ge(1)]
Number = Annotated[int, Ge(0)]
Positive = Annotated[float, Gt(0), Le(sys.float_info.max)]
Share = Annotated[float, Ge(0), Le(1)]

Distance = Annotated[float, Gt(0)]
"""Metres; infinity is one."""
HalfAngle = Annotated[float, Gt(0), Le(180)]
"""Degrees from an axis."""
FullAngle = Annotated[float, Gt(0), Le(360)]
"""Degrees across."""

Size = Annotated[tuple[Count, Count], Strict(False)]
"""Height, width; YAML has a list."""

Text = Annotated[str, MinLen(1)]
Names = Annotated[list[str | int], MinLen(1)]
Unit = Literal["m", "cm", "mm"]
Device = Annotated[str, Field(pattern=r"^(auto|(cpu|cuda|mps|xpu)(:\d+)?)$", description="auto, cpu or cuda")]


@dataclass(frozen=True)
class OnlyWith:
    """Mark of a key that counts only where another one has a value, as in ``Annotated[Count, OnlyWith("poses")]``.

    Attributes:
        needed: the other key, or with ``=a|b`` the values of which it needs one; of a list, one that it holds.
        word: what to give, for messages, where that is not ``needed``.
        parts: keys below this one that the mark is for; not given, it is for all.
    """

    needed: str
    word: str = ""
    parts: tuple[str, ...] = ()
