# SPDX-License-Identifier: Apache-2.0
"""Shapes said once: ``check_shapes`` makes a function refuse tensors that its annotations do not describe."""

from __future__ import annotations

import functools
import inspect
import re
import types
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, ParamSpec, TypeVar

import torch

from sphericalvision.core import ArgumentError, ShapeError, check_floating, check_tensor

P = ParamSpec("P")
R = TypeVar("R")
Sizes = dict[str, Sequence[int]]
Fits = Callable[[torch.Tensor, Sizes], bool]

_INTEGERS = (torch.int64, torch.int32, torch.uint8, torch.int16, torch.int8)
KINDS: dict[str, tuple[str, Callable[[torch.Tensor], bool]]] = {
    "Float": ("floating point values", torch.Tensor.is_floating_point),
    "Bool": ("bool", lambda value: value.dtype == torch.bool),
    "Int": ("integers", lambda value: value.dtype in _INTEGERS),
    "Integer": ("integers", lambda value: value.dtype in _INTEGERS),
    "Int32": ("int32", lambda value: value.dtype == torch.int32),
    "Num": ("numbers", lambda value: value.dtype != torch.bool),
    "Shaped": ("any values", lambda value: True),
}
"""Names of jaxtyping, what they are called in messages, and whether a tensor is of the kind."""
_ANNOTATION = re.compile(r"(\w+)\[Tensor, [\"'](.*?)[\"']\]")


def check_shapes(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function check the tensors that it is given against their annotations, before anything else runs.

    ``Float[Tensor, "B n C V"]`` asks for four dimensions and floating point numbers, ``Bool`` and ``Int`` for these;
    ``Num`` takes any numbers, ``Shaped`` anything. A name has one size in a call; ``#B`` is this size or 1, ``*batch``
    any number of dimensions, ``_`` and terms such as ``h+2`` any size. Of several annotations, joined by ``|``, one has
    to fit; ``| None`` allows None, and values of any other type are left to the function. Results are not checked, nor
    is anything in programs that are being compiled or exported, where sizes may be symbols.

    Put it on a public function or method, and remove what it repeats: ``check_tensor``, ``check_floating``,
    ``check_last_dim`` and comparisons of ``ndim`` and ``shape``. What no annotation says stays in the function, such as
    sizes that depend on a level.

    Raises:
        ArgumentTypeError: by the function, for an argument that is no tensor.
        ArgumentError: for numbers of another kind.
        ShapeError: for another shape; the message names the argument, the shape expected and the one that came.

    Examples:
        >>> from jaxtyping import Bool, Float
        >>> from torch import Tensor
        >>> def masked(values: Float[Tensor, "*batch n"], mask: Bool[Tensor, " n"] | None = None) -> Tensor:
        ...     return values if mask is None else values * mask
        >>> check_shapes(masked)(torch.ones(2, 3), torch.ones(4, dtype=torch.bool))
        Traceback (most recent call last):
        sphericalvision.core.ShapeError: mask: expected shape (3,), as of values, got (4,)
    """
    arguments = _arguments(function)
    plan = [(x.position, x.name, x.others, tuple(shape.check() for shape in x.shapes), x) for x in arguments]
    is_compiling = torch.compiler.is_compiling

    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if not is_compiling():
            sizes: Sizes = {}
            for position, name, others, checks, argument in plan:
                if position < len(args):
                    value = args[position]
                elif name in kwargs:
                    value = kwargs[name]
                else:
                    continue
                if isinstance(value, torch.Tensor):
                    for fits in checks:
                        if fits(value, sizes):
                            break
                    else:
                        argument.refuse(value, sizes, arguments)
                elif not (others == "any" or (value is None and others == "None")):
                    check_tensor(name, value, argument.text({}))
        return function(*args, **kwargs)

    # Code of its own: torch.compile keeps what it has compiled by code, and tracebacks show the function's name.
    name = getattr(function, "__name__", "call")
    code = call.__code__.replace(co_name=name)
    wrapper = types.FunctionType(code, call.__globals__, name, None, call.__closure__)
    return functools.update_wrapper(wrapper, function)  # type: ignore[return-value]


class _Shape(NamedTuple):
    """One annotation of a tensor, taken apart."""

    kind: str
    tokens: tuple[str, ...]
    least: int  # dimensions without those of a variadic name
    is_open: bool  # whether there is a variadic name
    fixed: tuple[tuple[int, int], ...]  # dimension and its size
    compared: tuple[tuple[slice, str, bool], ...]  # dimensions, name, whether they may be 1

    def text(self, sizes: Sizes) -> str:
        """The shape as messages show it, with the sizes that other arguments have."""
        shown: list[str] = []
        for token in self.tokens:
            name = token.lstrip("*#")
            if name in sizes:
                shown += map(str, sizes[name])
            else:
                shown.append("*" if token in ("...", "*batch", "*#batch") else token.replace("#", ""))
        return f"({', '.join(shown)}{',' if len(shown) == 1 and shown[0].isdigit() else ''})"

    def check(self) -> Fits:
        """Return whether a tensor fits, as a function of it and of sizes so far, to which it adds its own.

        A closure for each annotation, with all it needs at hand: a call of a camera waits for it.
        """
        _, is_kind = KINDS[self.kind]
        least, is_open, fixed, compared = self.least, self.is_open, self.fixed, self.compared
        if is_open and least == 1 and len(fixed) == 1 and not compared:
            last = (fixed[0][1],)  # points (*, 3) and pixels (*, 2)
            return lambda value, sizes: value.shape[-1:] == last and is_kind(value)

        def fits(value: torch.Tensor, sizes: Sizes) -> bool:
            shape = value.shape
            if len(shape) < least if is_open else len(shape) != least:
                return False
            for dim, size in fixed:
                if shape[dim] != size:
                    return False
            for dims, name, broadcast in compared:
                own = shape[dims]
                if not (broadcast and all(length == 1 for length in own)):
                    other = sizes.setdefault(name, own)
                    if own != other and not (broadcast and _broadcast(own, other)):
                        return False
            return is_kind(value)

        return fits


class _Argument(NamedTuple):
    """A parameter with shapes."""

    position: int
    name: str
    others: str  # than tensors: "", "None" or "any"
    shapes: tuple[_Shape, ...]

    def text(self, sizes: Sizes) -> str:
        """The shapes as messages show them."""
        return " or ".join(dict.fromkeys(shape.text(sizes) for shape in self.shapes))

    def refuse(self, value: torch.Tensor, sizes: Sizes, arguments: Sequence[_Argument]) -> None:
        """Raise what is wrong with a tensor: its kind of numbers, or its shape where others have these sizes."""
        kinds = dict.fromkeys(shape.kind for shape in self.shapes)
        if not any(KINDS[kind][1](value) for kind in kinds):
            if "Float" in kinds:
                check_floating(self.name, value)
            expected = " or ".join(KINDS[kind][0] for kind in kinds)
            raise ArgumentError(f"{self.name}: expected {expected}, got {value.dtype}")
        names = {name for shape in self.shapes for _, name, _ in shape.compared if name in sizes}
        sources = [
            argument.name
            for argument in arguments[: [argument.name for argument in arguments].index(self.name)]
            if any(name in names for shape in argument.shapes for _, name, _ in shape.compared)
        ]
        reason = f", as of {' and '.join(sources)}" if sources else ""
        raise ShapeError(f"{self.name}: expected shape {self.text(sizes)}{reason}, got {tuple(value.shape)}")


def _arguments(function: Callable[..., Any]) -> list[_Argument]:
    """Parameters whose annotations have shapes, but for those inside of tuples and mappings."""
    parsed = []
    for index, parameter in enumerate(inspect.signature(function).parameters.values()):
        annotation = parameter.annotation
        if not isinstance(annotation, str) or parameter.kind in (
            parameter.VAR_POSITIONAL,
            parameter.VAR_KEYWORD,
        ):
            continue
        members = re.split(r"\s*\|\s*", annotation)
        matches = [_ANNOTATION.fullmatch(member) for member in members]
        shapes = [(match[1], tuple(match[2].split())) for match in matches if match is not None]
        other = {member for member, match in zip(members, matches, strict=True) if match is None}
        if shapes:
            position = index if parameter.kind is not parameter.KEYWORD_ONLY else 1 << 30
            parsed.append((position, parameter.name, "any" if other - {"None"} else "".join(other), shapes))
    counts: dict[str, int] = {}
    for *_, shapes in parsed:
        # A name that only alternatives of one argument share compares nothing, unless it stands twice in one of them.
        names = [token.lstrip("*#") for _, tokens in shapes for token in tokens]
        twice = {token.lstrip("*#") for _, tokens in shapes for token in tokens if tokens.count(token) > 1}
        for name in set(names):
            counts[name] = counts.get(name, 0) + 1 + (name in twice)
    shared = {name for name, count in counts.items() if count > 1 and name.isidentifier() and name != "_"}
    return [
        _Argument(position, name, others, tuple(_shape(kind, tokens, shared) for kind, tokens in shapes))
        for position, name, others, shapes in parsed
    ]


def _shape(kind: str, tokens: tuple[str, ...], shared: set[str]) -> _Shape:
    """Take an annotation apart; dimensions behind a variadic name are counted from the end."""
    is_variadic = [token.startswith("*") or token == "..." for token in tokens]
    fixed, compared = [], []
    for index, token in enumerate(tokens):
        start = index - len(tokens) if any(is_variadic[:index]) else index
        end: int | None = index + 1 - len(tokens) if any(is_variadic[: index + 1]) else index + 1
        if token.isdigit():
            fixed.append((start, int(token)))
        elif token.lstrip("*#") in shared:
            compared.append((slice(start, end or None), token.lstrip("*#"), "#" in token))
    least = len(tokens) - sum(is_variadic)
    return _Shape(kind, tokens, least, any(is_variadic), tuple(fixed), tuple(compared))


def _broadcast(size: Sequence[int], other: Sequence[int]) -> bool:
    return all(1 in (a, b) or a == b for a, b in zip(reversed(size), reversed(other), strict=False))
