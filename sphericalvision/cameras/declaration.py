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

An instance has values under these names. For type checkers each has two types: that which is read, and that which the
constructor takes.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar, dataclass_transform

import torch
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.checks import check_precision, checked_angle, checked_numbers, checked_size
from sphericalvision.core import ArgumentError, ShapeError, check_choice
from sphericalvision.geometry.directions import broadcast_shapes, holds

ANY = 0
"""The size of an intrinsic of any number of numbers."""

_REQUIRED: Any = inspect.Parameter.empty


Value = TypeVar("Value")
Argument = TypeVar("Argument")


class Declared(Generic[Value, Argument]):
    """An argument of a camera's constructor: what is read from a camera, and what the constructor takes."""

    default: Any = _REQUIRED

    if TYPE_CHECKING:

        def __get__(self, camera: object, owner: object) -> Value: ...

        def __set__(self, camera: object, value: Argument) -> None: ...


class Intrinsic(Declared[Tensor, float | Sequence[float] | Tensor]):
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


class Choice(Declared[str, str]):
    """One of several words."""

    def __init__(self, *choices: str, default: Any = _REQUIRED) -> None:
        self.choices, self.default = choices, default


class ImageSize(Declared[tuple[int, int], Sequence[int]]):
    """(height, width)."""


class MaxAngle(Declared[Tensor, float | Tensor | None]):
    """Half the field of view in radians, a number or (*b,); by default where the model ends."""

    def __init__(self, default: Any = _REQUIRED) -> None:
        self.default = default


def constructor(
    declared: Mapping[str, Declared[Any, Any]], assign: Callable[[Any, dict[str, Any]], None]
) -> Any:
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


@dataclass_transform(
    eq_default=False, field_specifiers=(Choice, ImageSize, Intrinsic, MaxAngle, OptionalIntrinsic)
)
class DeclaredModel:
    """What a class has that declares its arguments: a constructor, checks, and batch dimensions that agree.

    Attributes that are ``Declared`` in the class become arguments in their order, after those of its bases.
    """

    declared: ClassVar[Mapping[str, Declared[Any, Any]]] = {}
    """The arguments of the constructor, in order. What follows comes from them, or is written by models that have a
    constructor of their own."""
    intrinsic_names: ClassVar[tuple[str, ...]] = ()
    """The tensor attributes, in the constructor's order."""
    option_names: ClassVar[tuple[str, ...]] = ()
    """Constructor arguments that are not tensors."""
    sizes: ClassVar[Mapping[str, tuple[int, ...]]] = {}
    """Intrinsic -> how many numbers its last dimension may hold; none, ``()``, means one number a camera, without a
    dimension of its own. Intrinsics that are not named hold any number."""
    optional_names: ClassVar[tuple[str, ...]] = ()
    """Those of ``intrinsic_names`` that may be ``None``."""
    default_names: ClassVar[tuple[str, ...]] = ()
    """Those of ``optional_names`` that files leave out where they are ``None``."""

    image_size: ImageSize
    max_angle: MaxAngle

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        own = {name: value for name, value in vars(cls).items() if isinstance(value, Declared)}
        if not own:
            return
        cls.declared = {**cls.declared, **own}
        intrinsics = {name: value for name, value in cls.declared.items() if isinstance(value, Intrinsic)}
        cls.intrinsic_names = tuple(intrinsics)
        cls.option_names = tuple(name for name, value in cls.declared.items() if isinstance(value, Choice))
        cls.sizes = {name: value.sizes for name, value in intrinsics.items() if value.sizes != (ANY,)}
        cls.optional_names = tuple(name for name, value in intrinsics.items() if value.optional)
        cls.default_names = tuple(name for name in cls.optional_names if intrinsics[name].default is None)
        if "__init__" not in vars(cls):
            cls.__init__ = constructor(cls.declared, cls._fill)  # type: ignore[method-assign]

    def __init__(
        self, image_size: Sequence[int], max_angle: float | Float[Tensor, "*#batch"], **intrinsics: Any
    ) -> None:
        self.image_size = checked_size(image_size)
        tensors = [value for value in (*intrinsics.values(), max_angle) if isinstance(value, Tensor)]
        floating = [value for value in tensors if value.is_floating_point()]
        like = floating[0] if floating else torch.empty(())
        check_precision(like.dtype)
        for name, value in intrinsics.items():
            if value is None and name not in self.optional_names:
                raise ArgumentError(f"{name}: expected numbers, got None; a {type(self).__name__} needs them")
            setattr(self, name, None if value is None else checked_numbers(name, value, like))
        self.max_angle = checked_angle(max_angle, like)
        self._check_intrinsics()
        self._broadcast()

    def _fill(self, values: dict[str, Any]) -> None:
        """What the constructor does with the values of what is declared."""
        for name, declared in self.declared.items():
            if isinstance(declared, Choice):
                check_choice(name, values[name], declared.choices)
                setattr(self, name, values[name])
        max_angle = values["max_angle"]
        intrinsics = {name: values[name] for name in self.intrinsic_names}
        DeclaredModel.__init__(
            self, values["image_size"], math.pi if max_angle is None else max_angle, **intrinsics
        )
        if max_angle is None:
            self.max_angle = self._model_end()

    def _check_intrinsics(self) -> None:
        """Raise unless sizes and numbers are those of the model."""
        for name in self.intrinsic_names:
            above = 0.0 if name == "focal_length" else -math.inf
            declared = self.declared.get(name) or Intrinsic(*self.sizes.get(name, (ANY,)), above=above)
            if isinstance(declared, Intrinsic) and getattr(self, name) is not None:
                declared.check(name, getattr(self, name))

    def _broadcast(self) -> None:
        """Give all intrinsics and ``max_angle`` the batch dimensions that they share."""
        names = self._tensor_names()
        leads = {name: self._batch_of(name) for name in names}
        try:
            batch = broadcast_shapes(*leads.values())
        except RuntimeError:
            shapes = ", ".join(f"{name} {tuple(getattr(self, name).shape)}" for name in names)
            raise ShapeError(
                f"intrinsics: expected batch dimensions that broadcast with each other, got {shapes}"
            ) from None
        for name in names:
            tensor = getattr(self, name)
            if leads[name] != batch:
                setattr(self, name, tensor.expand(*batch, *tensor.shape[len(leads[name]) :]))

    def _batch_of(self, name: str) -> tuple[int, ...]:
        """Batch dimensions of an intrinsic: all but the last one, or all of those that are one number a camera."""
        shape = tuple(getattr(self, name).shape)
        return shape if name == "max_angle" or self.sizes.get(name) == () else shape[:-1]

    def _model_end(self) -> Tensor:
        """Where the model ends, in radians from the axis: the default of ``max_angle``, which is π until then."""
        return self.max_angle

    def _tensor_names(self) -> tuple[str, ...]:
        return tuple(name for name in (*self.intrinsic_names, "max_angle") if getattr(self, name) is not None)
