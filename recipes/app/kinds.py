# SPDX-License-Identifier: Apache-2.0
"""Kinds of values that configurations have, as type hints: of the commands' keys, and of what configurations name."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Len, MinLen

__all__ = [
    "Count",
    "Distance",
    "FullAngle",
    "HalfAngle",
    "Names",
    "Number",
    "Positive",
    "Share",
    "Size",
    "Text",
    "Unit",
]

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

Size = Annotated[Sequence[Count], Len(2, 2)]
"""Height, width."""

Text = Annotated[str, MinLen(1)]
Names = Annotated[list[str | int], MinLen(1)]
Unit = Literal["m", "cm", "mm"]
