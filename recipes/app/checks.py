# SPDX-License-Identifier: Apache-2.0
"""Configurations as typed values: pydantic compares values with type hints, and errors name the key."""

import dataclasses
import inspect
import json
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from pydantic import ConfigDict, PydanticUserError, TypeAdapter, ValidationError
from pydantic.errors import PydanticInvalidForJsonSchema
from typing_extensions import is_typeddict

from sphericalvision.core import ArgumentError
from sphericalvision.recipes.app.kinds import OnlyWith

T = TypeVar("T")

TYPES = {
    "integer": "a whole number",
    "number": "a number",
    "string": "text",
    "boolean": "true or false",
    "null": "null",
    "array": "a list",
    "object": "a table",
}
"""Types of JSON schemas in words."""


def typed(kind: type[T], config: Mapping[str, Any], prefix: str = "") -> T:
    """Read a config into a pydantic dataclass or a ``TypedDict``.

    A nested dataclass takes its keys from the table of its name or, where there is none, from the table around it:
    ``start=3`` becomes ``capture.start``.

    Further keys are ignored. In messages, keys begin with ``prefix``.

    Raises:
        ArgumentError: a value does not fit its type; the message names the key.

    Examples:
        >>> from sphericalvision.recipes.app.rigs import Calibration
        >>> typed(Calibration, {"calibration": "rig.yaml", "max_angle_deg": 95.0}).max_angle_deg
        95.0
        >>> typed(Calibration, {"calibration": "rig.yaml", "max_angle_deg": 0.0})
        Traceback (most recent call last):
        ...
        sphericalvision.core.ArgumentError: max_angle_deg: expected a number above 0 and up to 180 or null, got 0.0
    """
    values = {}
    for field, hint in get_type_hints(kind, include_extras=True).items():
        name = key_of(field)
        nested = dataclasses.is_dataclass(hint) or is_typeddict(hint)
        if nested and name in config and isinstance(config[name], Mapping | DictConfig):
            values[field] = typed(hint, config[name], f"{prefix}{name}.")
        elif dataclasses.is_dataclass(hint):
            values[field] = typed(hint, config, prefix)  # type: ignore[arg-type]
        elif name in config.keys():  # noqa: SIM118 (those that lack a value, too)
            values[field] = checked(f"{prefix}{name}", config[name], hint)
    try:
        return kind(**values)
    except ValidationError as error:  # values are right, so that one is missing
        key = f"{prefix}{key_of(str(error.errors()[0]['loc'][0]))}"
        raise ArgumentError(f"{key} has no default; remove ~{key} or give a value") from None


def key_of(field: str) -> str:
    """Return the key of a field: ``with_`` is the key ``with``, which Python reserves.

    Examples:
        >>> key_of("with_"), key_of("image_size")
        ('with', 'image_size')
    """
    return field.removesuffix("_")


def flat(config: Any) -> dict[str, Any]:
    """Return key -> value of a dataclass of keys, the inverse of ``typed``: nested keys are at the top level."""
    values: dict[str, Any] = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        values |= flat(value) if dataclasses.is_dataclass(value) else {key_of(field.name): value}
    return values


def hints_of(kind: Any) -> dict[str, Any]:
    """Return key -> type hint of a dataclass or ``TypedDict``, flattened as by ``flat``."""
    hints: dict[str, Any] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        hints |= hints_of(hint) if dataclasses.is_dataclass(hint) else {key_of(name): hint}
    return hints


def marks_of(kind: Any) -> dict[str, OnlyWith]:
    """Return key -> its ``OnlyWith`` mark, of the keys that have one."""
    marks: dict[str, OnlyWith] = {}
    for name, hint in hints_of(kind).items():
        for mark in getattr(hint, "__metadata__", ()):
            if isinstance(mark, OnlyWith):
                marks |= dict.fromkeys([f"{name}.{key}" for key in mark.subkeys] or [name], mark)
    return marks


def check_keys(kind: Any, config: DictConfig, words: Sequence[str]) -> None:
    """Check the values of a command against their types, and that each key of its command line has an effect.

    Raises:
        ArgumentError: a value does not fit, or a key has no effect; the message names it.
        MissingMandatoryValue: a key has no value.
    """
    typed(kind, config)
    hints = hints_of(kind)
    for word in words:
        key = word.partition("=")[0]
        if key.startswith("+") and re.split(r"[.@/]", key.lstrip("+"))[0] not in {*hints, "hydra"}:
            raise ArgumentError(f"{key}: there is no such key, and none can be added")
    if wrong := unused_key(kind, config, [word.partition("=")[0] for word in words]):
        raise ArgumentError(wrong)


def unused_key(kind: Any, config: DictConfig, overrides: Iterable[str]) -> str | None:
    """Describe the first key among ``overrides`` that has no effect; None if all have one."""
    for key, mark in marks_of(kind).items():
        needed, equal, values = mark.needed.partition("=")
        value = OmegaConf.select(config, needed)
        present = set(map(str, value)) if OmegaConf.is_list(value) else {str(value)}
        counts = bool(present & {*values.split("|")}) if equal else value is not None
        if counts or (needed == "outputs" and value is None):  # null: the default outputs, clouds among them
            continue
        if unused := [name for name in overrides if f"{name}.".startswith(f"{key}.")]:
            remedy = mark.remedy or (mark.needed if equal else f"{needed}=...").replace("|", f" or {needed}=")
            return f"{unused[0]}: counts only with {remedy}; add that or leave it out"
    return None


def checked(key: str, value: Any, hint: Any) -> Any:
    """Return a value as its type hint has it; one of an object other than plain values stays as it is.

    Types are exact, no text for a number and no boolean for an integer, but lists may be tuples, as in JSON.

    Raises:
        ArgumentError: the value does not fit.

    Examples:
        >>> checked("level", 3, int), checked("size", [2, 3], tuple[int, int])
        (3, (2, 3))
        >>> checked("level", "3", int)
        Traceback (most recent call last):
        ...
        sphericalvision.core.ArgumentError: level: expected a whole number, got '3'
    """
    if (get_args(hint)[0] if get_origin(hint) is Annotated else hint) is Any:
        return value
    if OmegaConf.is_config(value):
        value = OmegaConf.to_container(value, resolve=True)
    try:
        return _adapter(hint).validate_json(json.dumps(value), strict=True)
    except PydanticUserError:
        return value
    except (ValidationError, TypeError):
        raise ArgumentError(f"{key}: expected {expected(hint)}, got {value!r}") from None


def expected(hint: Any) -> str:
    """Describe a type hint in words.

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


def check_node(config: Any, where: str, passed: Sequence[str] = ()) -> None:
    """Check the keys of the node at key ``where`` against the parameters of its ``_target_``, if it has one.

    The caller adds the parameters that are ``passed``.

    Raises:
        ArgumentError: a key that the target does not take, or a value that does not fit its type hint.
    """
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
        # A dataclass hints its fields, those of its parents where they stand; other classes what they are made of.
        fields = "__dataclass_fields__" in vars(target)
        hinted = target.__init__ if inspect.isclass(target) and not fields else target
        hints = get_type_hints(hinted, include_extras=True)
    except (TypeError, ValueError, NameError):  # built in C, or hints that only a type checker sees
        return
    open_ended = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values())
    for key in config:
        if str(key).startswith("_"):
            continue
        if key not in parameters and not open_ended:
            options = [name for name in parameters if name not in passed]
            name = str(config["_target_"]).rpartition(".")[2]
            raise ArgumentError(f"{where}.{key}: {name} has no such option; it has {', '.join(options)}")
        if isinstance(config, DictConfig) and OmegaConf.is_missing(config, key):
            raise ArgumentError(f"{where}.{key}: give a value on the command line, {where}.{key}=...")
        value = config[key]
        check_node(value, _source(config, key) or f"{where}.{key}")
        if key in hints and not isinstance(value, Mapping | DictConfig):
            checked(f"{where}.{key}", value, hints[key])


def _source(config: Any, key: Any) -> str | None:
    """Return the key that a value is taken from: ``rig`` for ``rig: ${rig}``."""
    written: Any = OmegaConf.to_container(config) if OmegaConf.is_config(config) else {}
    match = re.fullmatch(r"\$\{([\w.]+)\}", str(written.get(key)))
    return match[1] if match else None


def _adapter(hint: Any) -> TypeAdapter[Any]:
    try:
        return TypeAdapter(hint, config=ConfigDict(arbitrary_types_allowed=True))
    except PydanticUserError:  # it has a configuration of its own
        return TypeAdapter(hint)


def _in_words(schema: dict[str, Any]) -> str:
    """Describe a JSON schema, of the types that keys have."""
    if "description" in schema:
        return str(schema["description"])
    if "anyOf" in schema:
        return " or ".join(dict.fromkeys(map(_in_words, schema["anyOf"])))
    if choices := schema.get("enum", [schema["const"]] if "const" in schema else None):
        return "one of " + ", ".join(map(str, choices))
    min_items, max_items = schema.get("minItems", schema.get("minLength")), schema.get("maxItems")
    bounds = {
        "minimum": "of {} or more",
        "exclusiveMinimum": "above {}",
        "maximum": "up to {}",
    }
    limits = [text.format(schema[key]) for key, text in bounds.items() if key in schema]
    text = TYPES.get(schema.get("type", ""), "a value")
    if limits:
        text += " " + " and ".join(limits).replace(f"up to {sys.float_info.max}", "finite")
    if min_items:
        text += f" of {min_items}" if min_items == max_items else " (not empty)"
    # All items of our tuples are alike
    if items := schema.get("items") or schema.get("prefixItems", [None])[0]:
        text += f", each {_in_words(items)}"
    return text
