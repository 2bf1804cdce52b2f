# SPDX-License-Identifier: Apache-2.0
"""How a camera model is declared: each argument of its constructor once, with its size and its bounds.

The class attributes of a model are its constructor's arguments, in order, as with ``dataclasses``::

    class DoubleSphereCamera(Camera):
        focal_length: Intrinsic = Intrinsic(2, above=0)
        principal_point: Intrinsic = Intrinsic(2)
        xi: Intrinsic = Intrinsic(above=-1, below=1)
        alpha: Intrinsic = Intrinsic(least=0, most=1)
        image_size: ImageSize = ImageSize()
        max_angle: MaxAngle = MaxAngle(default=None)

An instance has values under these names. Their types are in ``__get__`` (what is read) and ``__set__`` (what the
constructor takes), which exist for type checkers only.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.geometry.directions import holds

__all__ = [
    "ANY",
    "Choice",
    "Declared",
    "ImageSize",
    "Intrinsic",
    "MaxAngle",
    "OptionalIntrinsic",
    "constructor",
]

ANY = 0
"""The size of an intrinsic of any number of numbers."""

_REQUIRED: Any = inspect.Parameter.empty


class Declared:
    """An argument of a camera's constructor."""

    default: Any = _REQUIRED


class Intrinsic(Declared):
    """A tensor (*b, n), or (*b,) of one number a camera.

    Args:
        sizes: the n that may be, or ``ANY``; none of them means one number a camera.
        above: all numbers are above it.
        below: all numbers are below it.
        least: the smallest number that may be.
        most: the largest number that may be.
        unit: of the numbers, in errors.
        named: what files call the numbers, in order; one number a camera is called like the intrinsic.
    """

    optional = False

    def __init__(
        self,
        *sizes: int,
        above: float = -math.inf,
        below: float = math.inf,
        least: float = -math.inf,
        most: float = math.inf,
        unit: str = "numbers",
        named: str = "",
    ) -> None:
        self.sizes, self.unit, self.named = sizes, unit, named
        self.above, self.below, self.least, self.most = above, below, least, most

    if TYPE_CHECKING:

        def __get__(self, camera: object, owner: object) -> Tensor: ...

        def __set__(self, camera: object, value: float | Sequence[float] | Tensor) -> None: ...

    def names(self, name: str) -> list[str]:
        """Of the numbers of the intrinsic ``name``."""
        return self.named.split() or [name]

    def check(self, name: str, value: Tensor) -> None:
        """Raise for another size, and for numbers out of bounds."""
        if self.sizes not in ((), (ANY,)) and (value.ndim == 0 or value.shape[-1] not in self.sizes):
            shapes = " or ".join(f"(*, {size})" for size in self.sizes)
            raise ShapeError(f"{name}: expected shape {shapes}, got {tuple(value.shape)}")
        bounded = max(self.above, self.least, -self.below, -self.most) > -math.inf
        if bounded and not holds(
            (value > self.above) & (value < self.below) & (value >= self.least) & (value <= self.most)
        ):
            raise ArgumentError(f"{name}: expected {self.unit} {self._bounds()}, got {value.tolist()}")

    def _bounds(self) -> str:
        low, high = max(self.above, self.least), min(self.below, self.most)
        first, last = ("π" if end == math.pi else f"{end:g}" for end in (low, high))
        if math.isinf(high):
            return f"above {first}" if self.above == low else f"of {first} at least"
        return f"in {'(' if self.above == low else '['}{first}, {last}{')' if self.below == high else ']'}"


class OptionalIntrinsic(Intrinsic):
    """An intrinsic that may be ``None``: by default, where it has a ``default``, and then files leave it out."""

    optional = True

    def __init__(self, *sizes: int, named: str = "", default: Any = _REQUIRED) -> None:
        super().__init__(*sizes, named=named)
        self.default = default

    if TYPE_CHECKING:

        def __get__(self, camera: object, owner: object) -> Tensor | None: ...  # type: ignore[override]

        def __set__(self, camera: object, value: float | Sequence[float] | Tensor | None) -> None: ...


class Choice(Declared):
    """One of several words."""

    def __init__(self, *choices: str, default: Any = _REQUIRED) -> None:
        self.choices, self.default = choices, default

    if TYPE_CHECKING:

        def __get__(self, camera: object, owner: object) -> str: ...

        def __set__(self, camera: object, value: str) -> None: ...


class ImageSize(Declared):
    """(height, width)."""

    if TYPE_CHECKING:

        def __get__(self, camera: object, owner: object) -> tuple[int, int]: ...

        def __set__(self, camera: object, value: Sequence[int]) -> None: ...


class MaxAngle(Declared):
    """Half the field of view in radians, a number or (*b,); by default where the model ends."""

    def __init__(self, default: Any = _REQUIRED) -> None:
        self.default = default

    if TYPE_CHECKING:

        def __get__(self, camera: object, owner: object) -> Tensor: ...

        def __set__(self, camera: object, value: float | Tensor | None) -> None: ...


def constructor(declared: Mapping[str, Declared], assign: Callable[[Any, dict[str, Any]], None]) -> Any:
    """The ``__init__`` that takes what is declared and hands it to ``assign``."""
    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    parameters = [inspect.Parameter("self", kind)]
    parameters += [inspect.Parameter(name, kind, default=d.default) for name, d in declared.items()]
    signature = inspect.Signature(parameters)

    def __init__(self: Any, *values: Any, **named: Any) -> None:
        bound = signature.bind(self, *values, **named)
        bound.apply_defaults()
        assign(self, {name: bound.arguments[name] for name in declared})

    __init__.__signature__ = signature  # type: ignore[attr-defined]
    return __init__
