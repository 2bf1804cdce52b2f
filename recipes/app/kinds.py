# SPDX-License-Identifier: Apache-2.0
"""Types of the values in configurations, as hints: of the commands' keys, and of parameters of ``_target_``s."""

import sys
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, MinLen
from pydantic import ConfigDict, Field, Strict

STRICT = ConfigDict(strict=True)
"""Configuration of dataclasses of keys: types are exact, no text for a number, no boolean for an integer."""

Count = Annotated[int, Ge(1)]
Number = Annotated[int, Ge(0)]
Positive = Annotated[float, Gt(0), Le(sys.float_info.max)]
Fraction = Annotated[float, Ge(0), Le(1)]

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
    """Mark of a key that has an effect only where another one has a value: ``Annotated[Count, OnlyWith("poses")]``.

    Attributes:
        needed: the other key; with ``=a|b`` it must have one of these values, or hold one if it is a list.
        remedy: what to add, for messages, where that is not ``needed``.
        subkeys: keys below this one that the mark is for; all if not given.
    """

    needed: str
    remedy: str = ""
    subkeys: tuple[str, ...] = ()
