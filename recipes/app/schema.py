# SPDX-License-Identifier: Apache-2.0
"""Checks of values by type hints, so that a wrong one is told by its key before anything starts."""

from __future__ import annotations

import inspect
import math
import re
import types
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

__all__ = ["AtLeast", "Exactly", "Finite", "Like", "NotEmpty", "check_config", "check_node", "problem"]

WORDS = {
    int: "a whole number",
    float: "a number",
    str: "text",
    bool: "true or false",
    type(None): "null",
}


@dataclass(frozen=True)
class AtLeast:
    """In ``Annotated``: the least number, or the bound that it must be above, and the greatest if there is one."""

    least: float
    above: bool = False
    most: float = math.inf

    def holds(self, value: Any) -> bool:
        """Whether a number keeps the bounds."""
        if not isinstance(value, int | float):
            return True
        return bool(value > self.least if self.above else value >= self.least) and value <= self.most

    def __str__(self) -> str:
        if self.most < math.inf:
            first = "above" if self.above else "from"
            return f"{first} {self.least:g} to {self.most:g}"
        return f"above {self.least:g}" if self.above else f"of {self.least:g} or more"


@dataclass(frozen=True)
class Finite:
    """In ``Annotated``: a number that is not infinite."""

    def holds(self, value: Any) -> bool:
        """Whether it is."""
        return not isinstance(value, float) or math.isfinite(value)

    def __str__(self) -> str:
        return "and finite"


@dataclass(frozen=True)
class NotEmpty:
    """In ``Annotated``: text or a list with something in it."""

    def holds(self, value: Any) -> bool:
        """Whether there is."""
        return not isinstance(value, str | list | tuple) or len(value) > 0

    def __str__(self) -> str:
        return "(not empty)"


@dataclass(frozen=True)
class Exactly:
    """In ``Annotated``: how many items a list has."""

    number: int

    def holds(self, value: Any) -> bool:
        """Whether it has."""
        return not isinstance(value, list | tuple) or len(value) == self.number

    def __str__(self) -> str:
        return f"({self.number} of them)"


@dataclass(frozen=True)
class Like:
    """In ``Annotated``: a regular expression for text, and how to say it."""

    pattern: str
    words: str

    def holds(self, value: Any) -> bool:
        """Whether all of the text is like that."""
        return not isinstance(value, str) or re.fullmatch(self.pattern, value) is not None

    def __str__(self) -> str:
        return self.words


BOUNDS = (AtLeast, Finite, NotEmpty, Exactly, Like)


def problem(value: Any, hint: Any) -> str | None:
    """What is expected in place of ``value``, or None where it fits ``hint``.

    Examples:
        >>> problem(3, int), problem("3", int), problem(True, int)
        (None, 'a whole number', 'a whole number')
        >>> problem(-1, Annotated[int, AtLeast(0)])
        'a whole number of 0 or more'
        >>> problem(3, list[int] | None)
        'a list of whole numbers or null'
        >>> problem("", Annotated[str, NotEmpty()])
        'text (not empty)'
        >>> problem([3], Annotated[list[int], Exactly(2)])
        'a list of whole numbers (2 of them)'
    """
    return None if _fits(value, hint) else _described(hint)


def check_config(config: DictConfig, schema: type, prefix: str = "") -> None:
    """Compare the keys of a config with the type hints of a class of the same names.

    Raises:
        ArgumentError: the first value that does not fit.
    """
    for key, hint in get_type_hints(schema, include_extras=True).items():
        if not prefix and key not in config.keys():  # noqa: SIM118 (`in` says no where a value is still missing)
            raise _error(f"{key}: this command needs the key; ~{key} takes it away")
        if (
            key in config
            and not OmegaConf.is_missing(config, key)
            and not OmegaConf.is_interpolation(config, key)
        ):
            node = config[key]
            _refuse(prefix + key, OmegaConf.to_container(node) if OmegaConf.is_config(node) else node, hint)


def check_node(config: Any, where: str, given: Sequence[str] = ()) -> None:
    """Compare the keys of a node that names a ``_target_`` with the target's parameters.

    Args:
        config: the node.
        where: its key, for messages.
        given: parameters that do not come from the node.

    Raises:
        ArgumentError: a key that the target does not take, or a value that does not fit its type hint.
    """
    if not isinstance(config, Mapping | DictConfig) or "_target_" not in config:
        return
    try:
        target = get_object(config["_target_"])
    except (ImportError, ValueError, AttributeError) as error:
        reason = " ".join(str(error).split())
        raise _error(f"{where}._target_: {config['_target_']!r} cannot be imported ({reason})") from error
    try:
        parameters = inspect.signature(target).parameters
        hints = get_type_hints(target.__init__ if inspect.isclass(target) else target, include_extras=True)
    except (TypeError, ValueError, NameError):  # built in C, or hints that only a type checker sees
        return
    open_ended = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values())
    for key in config:
        if str(key).startswith("_"):
            continue
        if key not in parameters and not open_ended:
            known = [name for name in parameters if name not in given]
            name = str(config["_target_"]).rpartition(".")[2]
            raise _error(f"{where}.{key}: {name} has no such option; it has {', '.join(known)}")
        if isinstance(config, DictConfig) and OmegaConf.is_missing(config, key):
            raise _error(
                f"{where}.{key}: a value is needed here; give it on the command line as {where}.{key}=..."
            )
        value = config[key]
        if isinstance(value, DictConfig) and "_target_" in value:
            check_node(value, _place(config, key) or f"{where}.{key}")
        if OmegaConf.is_config(value):
            value = OmegaConf.to_container(value, resolve=True)
        if key in hints and not isinstance(value, dict):
            _refuse(f"{where}.{key}", value, hints[key])


def _place(config: Any, key: Any) -> str | None:
    """The key that another one stands for: ``rig`` for ``rig: ${rig}``."""
    if not isinstance(config, DictConfig) or not OmegaConf.is_interpolation(config, key):
        return None
    node: Any = config._get_node(key)
    match = re.fullmatch(r"\$\{([\w.]+)\}", str(node._value()))
    return match[1] if match else None


def _refuse(key: str, value: Any, hint: Any) -> None:
    expected = problem(value, hint)
    if expected is not None:
        raise _error(f"{key}: expected {expected}, got {value!r}")


def _error(message: str) -> Exception:
    from sphericalvision.core import (
        ArgumentError,  # imports torch, which a right command line does not wait for here
    )

    return ArgumentError(message)


def _fits(value: Any, hint: Any) -> bool:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        bounds = [bound for bound in arguments[1:] if isinstance(bound, BOUNDS)]
        return _fits(value, arguments[0]) and all(bound.holds(value) for bound in bounds)
    if origin in (Union, types.UnionType):
        return any(_fits(value, choice) for choice in arguments)
    if origin is Literal:
        return any(value == choice and type(value) is type(choice) for choice in arguments)
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if hint in (str, bool, type(None)):
        return isinstance(value, hint)
    if origin in (list, Sequence, tuple) or hint in (list, Sequence, tuple):
        items = [choice for choice in arguments if choice is not Ellipsis]
        if not isinstance(value, list | tuple):
            return False
        return not items or all(any(_fits(item, choice) for choice in items) for item in value)
    if hint is Any:
        return True
    # A class of which values of files know nothing: what is no plain value may be one.
    return not isinstance(value, int | float | str | bool | type(None)) or not inspect.isclass(hint)


def _described(hint: Any) -> str:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        like = [bound for bound in arguments[1:] if isinstance(bound, Like)]
        if like:
            return str(like[0])
        return " ".join([_described(arguments[0]), *(str(b) for b in arguments[1:] if isinstance(b, BOUNDS))])
    if origin in (Union, types.UnionType):
        known = [choice for choice in arguments if not inspect.isclass(choice) or choice in WORDS]
        return " or ".join(dict.fromkeys(_described(choice) for choice in known))
    if origin is Literal:
        return "one of " + ", ".join(map(str, arguments))
    if origin in (list, Sequence, tuple):
        items = [_described(choice) for choice in arguments if choice is not Ellipsis]
        many = [
            re.sub(r"\bnumber\b", "numbers", item.removeprefix("a ").replace(" or a ", " or "))
            for item in items
        ]
        inner = " or ".join(dict.fromkeys(many))
        return f"a list of {inner}" if inner else "a list"
    return WORDS.get(hint, getattr(hint, "__name__", str(hint)))
