# SPDX-License-Identifier: Apache-2.0
"""Values of configurations compared with type hints by pydantic, so that a wrong one is told by its key at once."""

from __future__ import annotations

import inspect
import json
import re
import sys
from collections.abc import Mapping, Sequence
from typing import Any, get_type_hints

from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from pydantic import ConfigDict, PydanticUserError, TypeAdapter, ValidationError
from pydantic.errors import PydanticInvalidForJsonSchema

__all__ = ["check_node", "expected", "fault"]

WORDS = {
    "integer": "a whole number",
    "number": "a number",
    "string": "text",
    "boolean": "true or false",
    "null": "null",
    "array": "a list",
    "object": "a table",
}
"""What types of JSON's schemas are called."""


def fault(key: str, value: Any, hint: Any) -> str | None:
    """What is wrong with a value of a key, in one sentence; None where it fits the type hint.

    Types are exact: no text for a number, no truth value for a whole number.

    Examples:
        >>> fault("level", 3, int), fault("level", "3", int)
        (None, "level: expected a whole number, got '3'")
    """
    try:
        adapter = _adapter(hint)
    except PydanticUserError:  # a hint that says nothing of plain values
        return None
    try:
        adapter.validate_python(value, strict=True)
    except ValidationError:
        try:  # where a tuple is expected, files have a list, as JSON does
            adapter.validate_json(json.dumps(value), strict=True)
        except (ValidationError, TypeError):
            return f"{key}: expected {expected(hint)}, got {value!r}"
    return None


def expected(hint: Any) -> str:
    """A type hint in words.

    Examples:
        >>> from sphericalvision.recipes.app.kinds import Count, Positive, Size
        >>> expected(Count | None)
        'a whole number of 1 or more or null'
        >>> expected(Size)
        'a list of 2, each a whole number of 1 or more'
        >>> expected(Positive)
        'a number above 0 and finite'
    """
    try:
        return _in_words(_adapter(hint).json_schema(mode="validation"))
    except (PydanticUserError, PydanticInvalidForJsonSchema):
        return str(getattr(hint, "__name__", hint))


def check_node(config: Any, where: str, given: Sequence[str] = ()) -> None:
    """Compare the keys of a node that names a ``_target_`` with the target's parameters.

    Args:
        config: the node.
        where: its key, for messages.
        given: parameters that do not come from the node.

    Raises:
        ArgumentError: a key that the target does not take, or a value that does not fit its type hint.
    """
    from sphericalvision.core import ArgumentError

    if not isinstance(config, Mapping | DictConfig) or "_target_" not in config:
        return
    try:
        target = get_object(config["_target_"])
    except (ImportError, ValueError, AttributeError) as error:
        reason = " ".join(str(error).split())
        raise ArgumentError(
            f"{where}._target_: {config['_target_']!r} cannot be imported ({reason})"
        ) from error
    try:
        parameters = inspect.signature(target).parameters
        fields = "__dataclass_fields__" in vars(target)  # inherited ones are hinted where they stand
        hinted = target.__init__ if inspect.isclass(target) and not fields else target
        hints = get_type_hints(hinted, include_extras=True)
    except (TypeError, ValueError, NameError):  # built in C, or hints that only a type checker sees
        return
    open_ended = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values())
    for key in config:
        if str(key).startswith("_"):
            continue
        if key not in parameters and not open_ended:
            known = [name for name in parameters if name not in given]
            name = str(config["_target_"]).rpartition(".")[2]
            raise ArgumentError(f"{where}.{key}: {name} has no such option; it has {', '.join(known)}")
        if isinstance(config, DictConfig) and OmegaConf.is_missing(config, key):
            raise ArgumentError(
                f"{where}.{key}: a value is needed here; give it on the command line as {where}.{key}=..."
            )
        value = config[key]
        check_node(value, _place(config, key) or f"{where}.{key}")
        if OmegaConf.is_config(value):
            value = OmegaConf.to_container(value, resolve=True)
        if (
            key in hints
            and not isinstance(value, dict)
            and (wrong := fault(f"{where}.{key}", value, hints[key]))
        ):
            raise ArgumentError(wrong)


def _place(config: Any, key: Any) -> str | None:
    """The key that another one stands for: ``rig`` for ``rig: ${rig}``."""
    if not isinstance(config, DictConfig) or not OmegaConf.is_interpolation(config, key):
        return None
    node: Any = config._get_node(key)
    match = re.fullmatch(r"\$\{([\w.]+)\}", str(node._value()))
    return match[1] if match else None


def _adapter(hint: Any) -> TypeAdapter[Any]:
    try:
        return TypeAdapter(hint, config=ConfigDict(arbitrary_types_allowed=True))
    except PydanticUserError:  # it has a configuration of its own
        return TypeAdapter(hint)


def _in_words(schema: dict[str, Any]) -> str:
    """A schema of JSON's, as far as type hints of keys make them."""
    if "description" in schema:
        return str(schema["description"])
    if "anyOf" in schema:
        return " or ".join(dict.fromkeys(map(_in_words, schema["anyOf"])))
    if choices := schema.get("enum", [schema["const"]] if "const" in schema else None):
        return "one of " + ", ".join(map(str, choices))
    least, most = schema.get("minItems", schema.get("minLength")), schema.get("maxItems")
    bounds = {
        "minimum": "of {} or more",
        "exclusiveMinimum": "above {}",
        "maximum": "up to {}",
    }
    limits = [text.format(schema[key]) for key, text in bounds.items() if key in schema]
    words = WORDS.get(schema.get("type", ""), "a value")
    if limits:
        words += " " + " and ".join(limits).replace(f"up to {sys.float_info.max}", "finite")
    if least:
        words += f" of {least}" if least == most else " (not empty)"
    if items := schema.get("items"):
        words += f", each {_in_words(items)}"
    return words
