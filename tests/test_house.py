# SPDX-License-Identifier: Apache-2.0
"""Rules of the house that import-linter cannot say: private names stay in their folder, and imports go in no circle.

Every import counts for circles: at the top of a file, inside functions, and for type checkers only.
"""

import ast
import re
import tomllib
from collections.abc import Iterator
from functools import cache

from tests.house_numbers import ROOT, counted, lines, modules


@cache
def trees() -> dict[str, ast.Module]:
    """Every file of the package, parsed."""
    return {module: ast.parse(path.read_text()) for module, path in modules().items()}


def imported(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """Module and name of every ``from module import name``; of ``import module`` with an empty name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield from ((node.module, alias.name) for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)


def folder_of(module: str) -> str:
    """Package in which a module lies; a package lies in itself."""
    return module if modules()[module].name == "__init__.py" else module.rpartition(".")[0]


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def private_crossings(module: str, tree: ast.AST) -> Iterator[str]:
    """Private names of other folders that a file imports, or reaches through a module that it imports."""
    aliases = {}
    for source, name in imported(tree):
        full = f"{source}.{name}" if f"{source}.{name}" in modules() else source
        if full not in modules() or folder_of(full) == folder_of(module):
            continue
        private = is_private(name) or any(map(is_private, full.split(".")))
        if private:
            yield f"{module} imports {name} of {source}"
        elif full != source:
            aliases[name] = full
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and is_private(node.attr) and isinstance(node.value, ast.Name):
            module_of_name = aliases.get(node.value.id)
            if module_of_name:
                yield f"{module} uses {node.attr} of {module_of_name}"


def test_no_private_name_crosses_a_folder() -> None:
    found = [crossing for module, tree in trees().items() for crossing in private_crossings(module, tree)]
    assert not found, "make the name public in its folder, or move what needs it:\n" + "\n".join(found)


def private_members(tree: ast.AST) -> set[str]:
    """Names of private methods, and of private attributes that a file sets."""
    defined = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    set_here = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)
    }
    return set(filter(is_private, defined | set_here))


def private_uses(tree: ast.AST) -> Iterator[str]:
    """Private members that a file asks of objects other than ``self``, ``cls`` and ``super()``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and is_private(node.attr):
            owner = ast.unparse(node.value)
            if owner not in ("self", "cls") and not owner.startswith("super("):
                yield node.attr


def test_no_private_member_is_used_from_another_folder() -> None:
    by_folder: dict[str, set[str]] = {}
    for module, tree in trees().items():
        by_folder.setdefault(folder_of(module), set()).update(private_members(tree))
    ours = set().union(*by_folder.values())
    found = [
        f"{module} uses {name}"
        for module, tree in trees().items()
        for name in private_uses(tree)
        if name in ours - by_folder[folder_of(module)]
    ]
    assert not found, "give the folder that has it a public function for it:\n" + "\n".join(found)


def circle(graph: dict[str, set[str]]) -> list[str]:
    """Modules that import each other, one after the other and back to the first; none if there are no circles."""
    done: set[str] = set()

    def visit(module: str, path: list[str]) -> list[str]:
        if module in path:
            return [*path[path.index(module) :], module]
        if module not in done:
            for other in sorted(graph[module]):
                if found := visit(other, [*path, module]):
                    return found
            done.add(module)
        return []

    return next((found for module in sorted(graph) if (found := visit(module, []))), [])


def test_imports_go_in_no_circle() -> None:
    graph: dict[str, set[str]] = {module: set() for module in modules()}
    for module, tree in trees().items():
        for source, name in imported(tree):
            target = f"{source}.{name}" if f"{source}.{name}" in graph else source
            if target in graph and target != module:
                graph[module].add(target)
    assert sum(map(len, graph.values())) > 500  # the imports were found
    assert not circle(graph), " -> ".join(circle(graph))


def test_breaches_are_noticed() -> None:
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]
    assert circle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []
    program = """
def f():
    from sphericalvision.icosphere.pooling import _max
    from sphericalvision.icosphere import topology
    return topology._private
"""
    assert len(list(private_crossings("sphericalvision.sphere.grids.sphere_grid", ast.parse(program)))) == 2
    assert not list(private_crossings("sphericalvision.icosphere.areas", ast.parse(program)))
    uses = "self._a(), cls._b, super()._c(), camera._map(f), self.cameras[0]._project(x), a.__len__()"
    assert list(private_uses(ast.parse(uses))) == ["_map", "_project"]
    assert private_members(ast.parse("class A:\n    def _f(self): self._x = self._y")) == {"_f", "_x"}


def test_the_house_does_not_grow() -> None:
    """Two numbers in ``pyproject.toml`` may only fall; who raises one says in the commit what the lines replace."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["sphericalvision"]["house"]
    assert lines("sphericalvision", "recipes") <= settings["product_lines"]
    assert lines("tests") <= settings["test_lines"]


def test_the_numbers_of_contributing_hold() -> None:
    table = (ROOT / "CONTRIBUTING.md").read_text().partition("## Numbers of the house")[2]
    wanted = dict(re.findall(r"^\| ([^|]+) \|.* \| ([\d,]+) \|$", table, re.MULTILINE))
    assert not {
        name: number for name, number in counted().items() if number > int(wanted[name].replace(",", ""))
    }
