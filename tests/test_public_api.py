# SPDX-License-Identifier: Apache-2.0
"""The public names with their arguments and defaults, checked against a list that is kept in the repository.

`tests/public_api.txt` is that list: one `module: name(argument, other=default)` a line. What appears, disappears or
changes there is a decision, so the list is changed by hand or with
`python tests/test_public_api.py > tests/public_api.txt` and read in review.
"""

import doctest
import enum
import importlib
import inspect
import re
from pathlib import Path
from typing import Any

import pytest

INVENTORY = Path(__file__).with_name("public_api.txt")

PACKAGES = (
    "sphericalvision.cameras",
    "sphericalvision.capture",
    "sphericalvision.core",
    "sphericalvision.crown",
    "sphericalvision.data",
    "sphericalvision.geometry",
    "sphericalvision.icosphere",
    "sphericalvision.kernels",
    "sphericalvision.losses",
    "sphericalvision.metrics",
    "sphericalvision.models",
    "sphericalvision.scenes",
    "sphericalvision.sphere",
    "sphericalvision.sweep",
    "sphericalvision.viz",
)


def public_names() -> list[str]:
    """What every public package offers."""
    return sorted(
        f"{package}: {name}"
        for package in PACKAGES
        for module in [importlib.import_module(package)]
        for name in module.__all__
        if not inspect.ismodule(getattr(module, name))
    )


def arguments(function: Any) -> str:
    """As they are declared, without their types; classes and functions among the defaults by name."""
    parameters = [
        each.replace(annotation=inspect.Parameter.empty)
        for name, each in inspect.signature(function).parameters.items()
        if name not in ("self", "cls")
    ]
    return re.sub(r"<(?:class '[\w.]*\.|function )(\w+)[^>]*>", r"\1", str(inspect.Signature(parameters)))


def inventory() -> list[str]:
    """Its lines: names, then what classes define to be called, under the class."""
    lines = []
    for line in public_names():
        package, name = line.split(": ")
        found = getattr(importlib.import_module(package), name)
        if not inspect.isclass(found):
            lines.append(line + arguments(found) if inspect.isfunction(found) else line)
            continue
        has_arguments = not issubclass(found, BaseException | enum.Enum) and not inspect.isabstract(found)
        lines.append(line + arguments(found) if has_arguments else line)
        for method in sorted(vars(found)):
            body = inspect.getattr_static(found, method)
            body = getattr(body, "__func__", body)
            if not method.startswith("_") and inspect.isfunction(body):
                lines.append(f"{line}.{method}{arguments(body)}")
    return lines


def test_public_names_are_the_inventory() -> None:
    expected = INVENTORY.read_text().splitlines()
    now = inventory()
    appeared, gone = sorted(set(now) - set(expected)), sorted(set(expected) - set(now))
    assert now == expected, (
        f"new: {appeared}; gone: {gone}; if meant, update {INVENTORY.name} (see the top of this file)"
    )


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_exists_and_says_what_it_is(package: str) -> None:
    module = importlib.import_module(package)
    for name in module.__all__:
        found = getattr(module, name)
        if inspect.isclass(found) or inspect.isfunction(found):
            assert inspect.getdoc(found), f"{package}.{name} has no docstring"


NO_EXAMPLE: dict[str, str] = {}
"""Names without an example, and why; empty is best."""


def test_every_public_name_has_an_example_that_prints() -> None:
    """Classes and functions show what they return; ``tests/test_doctests.py`` runs the examples."""
    parser, silent = doctest.DocTestParser(), []
    for line in public_names():
        package, name = line.split(": ")
        found = getattr(importlib.import_module(package), name)
        if not (inspect.isclass(found) or inspect.isfunction(found)):
            continue
        if not any(example.want for example in parser.get_examples(found.__doc__ or "")):
            silent.append(f"{package}.{name}")
    assert silent == sorted(NO_EXAMPLE), "give each an example in its docstring, or a reason in NO_EXAMPLE"


if __name__ == "__main__":
    print("\n".join(inventory()))
