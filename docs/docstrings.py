# SPDX-License-Identifier: Apache-2.0
"""Docstrings as the API's pages show them: what is printed can be pasted.

Shapes, as in "points (*, 3)", are code: Markdown takes two stars for emphasis. An example is a program that begins with
its imports, without prompts, its output in comments. A camera has the constructor that its declaration makes, with
sizes, bounds and units of the intrinsics.
"""

from __future__ import annotations

import ast
import builtins
import doctest
import functools
import importlib
import inspect
import math
import re
import textwrap
from types import ModuleType
from typing import Any

import griffe

from sphericalvision.cameras import Camera
from sphericalvision.cameras.declaration import ANY, Choice, Intrinsic

SHAPE = re.compile(r"(?<![\w`])\(\*\w*(?:, [^()`]*)?\)")
"""A shape whose first size is any number of sizes; no call."""
PACKAGES = (
    "sphericalvision",
    *(
        f"sphericalvision.{name}"
        for name in (
            "cameras",
            "icosphere",
            "sphere",
            "crown",
            "sweep",
            "models",
            "losses",
            "metrics",
            "data",
            "scenes",
            "viz",
            "capture",
            "geometry",
        )
    ),
)
"""Packages that names are imported from, if they have them; other names come from the file they are written in."""
PIXELS = ("focal_length", "principal_point")


def as_code(text: str) -> str:
    """Put the shapes of a docstring into backticks, but for those in code and in examples."""
    lines = []
    for line in text.split("\n"):
        if not re.match(r"\s*(>>>|\.\.\.)", line):
            parts = re.split(r"(`+[^`]*`+)", line)
            line = "".join(
                part if part.startswith("`") else SHAPE.sub(r"``\g<0>``", part)
                for part in parts
            )
        lines.append(line)
    return "\n".join(lines)


@functools.cache
def public_names() -> dict[str, str]:
    """Name -> the package that exports it, the first one of several."""
    return {
        name: package
        for package in reversed(PACKAGES)
        for name in importlib.import_module(package).__all__
    }


def import_line(name: str, module: ModuleType) -> str:
    """The line that brings a global name of a module into a program."""
    value = getattr(module, name)
    if isinstance(value, ModuleType):
        parent, _, last = value.__name__.rpartition(".")
        if value.__name__ == name:
            return f"import {name}"
        return (
            f"from {parent} import {last}"
            if last == name
            else f"import {value.__name__} as {name}"
        )
    package = public_names().get(name)
    if package and getattr(importlib.import_module(package), name, None) is value:
        return f"from {package} import {name}"
    home = getattr(value, "__module__", module.__name__)
    is_there = hasattr(importlib.import_module(home), name)
    return f"from {home if is_there else module.__name__} import {name}"


def used_names(program: str) -> set[str]:
    """Names that a program uses and does not bind itself."""
    nodes = list(ast.walk(ast.parse(program)))
    loaded = {
        node.id
        for node in nodes
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)
    }
    bound = {
        node.id
        for node in nodes
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
    }
    for node in nodes:
        if isinstance(node, ast.Import | ast.ImportFrom):
            bound |= {
                alias.asname or alias.name.partition(".")[0] for alias in node.names
            }
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            bound.add(node.name)
        elif isinstance(node, ast.arg):
            bound.add(node.arg)
    return loaded - bound - set(dir(builtins))


def as_program(section: str, module: ModuleType) -> str:
    """The examples of a docstring as one block of Python, which runs alone; what they print stands in comments."""
    parsed = doctest.DocTestParser().parse(section)
    examples = [piece for piece in parsed if isinstance(piece, doctest.Example)]
    program = "".join(example.source for example in examples)
    names = sorted(name for name in used_names(program) if hasattr(module, name))
    grouped: dict[str, list[str]] = {}
    for line in (import_line(name, module) for name in names):
        head, _, name = line.partition(" import ")
        grouped.setdefault(head, []).append(name)
    imports = [
        f"{head} import {', '.join(names)}" if names[0] else head
        for head, names in sorted(grouped.items())
    ]
    if "torch." in program and "import torch" not in program:
        imports = sorted({*imports, "import torch"})
    lines = [*sorted(imports, key=lambda line: line.startswith("from")), ""]
    for piece in parsed:
        if isinstance(piece, doctest.Example):
            lines += piece.source.rstrip("\n").split("\n")
            lines += [
                f"# {line}".rstrip()
                for line in piece.want.rstrip("\n").split("\n")
                if piece.want
            ]
        elif piece.strip():
            lines += [f"# {line}" for line in piece.strip().split("\n") if line]
    return "\n".join(lines).strip() + "\n"


def with_programs(text: str, module: ModuleType) -> str:
    """A docstring whose section of examples is a block of Python."""
    head, mark, rest = text.partition("\nExamples:\n")
    if not mark or ">>>" not in rest:
        return text
    lines = rest.split("\n")
    end = next(
        (
            number
            for number, line in enumerate(lines)
            if line and not line.startswith(" ")
        ),
        len(lines),
    )
    program = as_program(textwrap.dedent("\n".join(lines[:end])), module)
    block = textwrap.indent(f"```python\n{program}```", "    ")
    return "\n".join([head + "\nExamples:", block, "", *lines[end:]])


def shape_of(sizes: tuple[int, ...]) -> str:
    """The shape of an intrinsic that may hold so many numbers."""
    if not sizes:
        return "(*,)"
    if sizes == (ANY,):
        return "(*, k)"
    if len(sizes) > 2 and sizes == tuple(range(sizes[0], sizes[-1] + 1)):
        return f"(*, k) with k from {sizes[0]} to {sizes[-1]}"
    return f"(*, {' or '.join(map(str, sizes))})"


def arguments_of(camera: type[Camera]) -> str:
    """Sections of a docstring on what a camera's constructor takes and refuses, from its declaration."""
    lines = ["Args:"]
    for name, declared in camera.declared.items():
        if isinstance(declared, Intrinsic):
            sizes = shape_of(declared.sizes)
            bounds = [
                f"{text} {value:g}"
                for text, value in (
                    ("above", declared.above),
                    ("below", declared.below),
                    ("at least", declared.least),
                    ("at most", declared.most),
                )
                if math.isfinite(value)
            ]
            unit = "pixels" if name in PIXELS else ""
            called = (
                f"({', '.join(declared.named.split())})" if declared.named else ""
            )
            optional = "or None" if declared.optional else ""
            words = [sizes, called, unit, *bounds, optional]
            lines.append(f"    {name}: {', '.join(filter(None, words))}.")
        elif isinstance(declared, Choice):
            choices = ", ".join(f'``"{choice}"``' for choice in declared.choices)
            lines.append(f"    {name}: one of {choices}.")
    lines += [
        "    image_size: height and width, pixels.",
        "    max_angle: the largest angle from the axis that is seen, radians; None for that where the model ends.",
        "",
        "Raises:",
        "    ShapeError: an intrinsic of another size, or batch dimensions that do not broadcast.",
        "    ArgumentError: a number that is not finite or out of bounds, or no image size.",
    ]
    return "\n".join(lines)


class Docstrings(griffe.Extension):
    """What Griffe calls for each object that it reads."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite its docstring."""
        if obj.docstring:
            text = as_code(obj.docstring.value)
            if ">>>" in text:
                module = importlib.import_module(obj.module.path)
                text = with_programs(text, module)
            obj.docstring.value = text

    def on_class_members(self, *, cls: griffe.Class, **_: Any) -> None:
        """Give a camera the constructor that its declaration makes."""
        if not cls.module.path.startswith("sphericalvision.cameras."):
            return
        value = getattr(importlib.import_module(cls.module.path), cls.name, None)
        if (
            not inspect.isclass(value)
            or not issubclass(value, Camera)
            or "__init__" in cls.members
            or not value.declared
        ):
            return
        parameters = [
            griffe.Parameter(
                name,
                kind=griffe.ParameterKind.positional_or_keyword,
                default=None
                if parameter.default is parameter.empty
                else repr(parameter.default),
            )
            for name, parameter in inspect.signature(value).parameters.items()
        ]
        self_parameter = griffe.Parameter(
            "self", kind=griffe.ParameterKind.positional_or_keyword
        )
        cls.set_member(
            "__init__",
            griffe.Function(
                "__init__",
                parameters=griffe.Parameters(self_parameter, *parameters),
                docstring=None,
                lineno=cls.lineno,  # its source is the declaration
                endlineno=cls.endlineno,
            ),
        )
        if cls.docstring and "Args:" not in cls.docstring.value:
            head, mark, rest = cls.docstring.value.partition("\nExamples:\n")
            cls.docstring.value = (
                f"{head.rstrip()}\n\n{as_code(arguments_of(value))}\n{mark}{rest}"
            )
