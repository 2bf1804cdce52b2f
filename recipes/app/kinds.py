# SPDX-License-Identifier: Apache-2.0
"""Kinds of values that configurations have, as type hints: of the commands' keys, and of what configurations name."""

from __future__ import annotations

from typing import Annotated, Literal

from sphericalvision.recipes.app.schema import AtLeast, Exactly, Finite, Like, NotEmpty

__all__ = [
    "Count",
    "Device",
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

Count = Annotated[int, AtLeast(1)]
Number = Annotated[int, AtLeast(0)]
Positive = Annotated[float, AtLeast(0, above=True), Finite()]
Share = Annotated[float, AtLeast(0, most=1)]

Distance = Annotated[float, AtLeast(0, above=True)]
"""Metres; infinity is one."""
HalfAngle = Annotated[float, AtLeast(0, above=True, most=180)]
"""Degrees from an axis."""
FullAngle = Annotated[float, AtLeast(0, above=True, most=360)]
"""Degrees across."""

Size = Annotated[list[Count], Exactly(2)]
"""Height, width."""

Text = Annotated[str, NotEmpty()]
Names = Annotated[list[str | int], NotEmpty()]
Unit = Literal["m", "cm", "mm"]
Device = Annotated[str, Like(r"auto|(cpu|cuda|mps|xpu)(:\d+)?", "auto, cpu or cuda")]
