# SPDX-License-Identifier: Apache-2.0
"""An import hook that checks tensors against the annotations of the package's public functions.

``def locate(directions: Float[Tensor, "*batch 3"], level: int) -> tuple[Int[Tensor, "*batch 3"], ...]`` says which
shapes and kinds of numbers go in and come out; a name means the same size everywhere in one call. Outside the tests
annotations are words. Here every public function, and every public method of a public class, is wrapped when its module
is imported: a call that returns although its arguments or its answer contradict the annotations fails.

Arguments are looked at after the call, so that a function's own errors come first. Programs that are being traced
(``torch.compile``, ``torch.export``) are not checked: their sizes may be symbols.
"""

import builtins
import functools
import inspect
import sys
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from typing import Any, ForwardRef, Union, get_args, get_origin

import torch
from jaxtyping import AbstractArray, jaxtyped
from torch import Tensor

PACKAGE = "sphericalvision"
LEFT_OUT = (f"{PACKAGE}.recipes", f"{PACKAGE}.conf")
SHAPED = "[Tensor,"  # what annotations with a shape contain


class AnnotationError(AssertionError):
    """A call contradicts its annotations."""


class Names(dict[str, Any]):
    """Names of a module; those that it imports for type checkers only stand for anything."""

    def __missing__(self, name: str) -> Any:
        if name.startswith("__"):  # pytest asks frames for __tracebackhide__
            raise KeyError(name)
        return getattr(builtins, name, Any)


def written(annotation: Any) -> str:
    """An annotation as it is written in the code."""
    return (
        annotation if isinstance(annotation, str) else getattr(annotation, "__forward_arg__", str(annotation))
    )


def evaluate(annotation: Any, names: Mapping[str, Any]) -> Any:
    """The type that an annotation, a string or not, stands for in a module with these names."""
    if isinstance(annotation, str | ForwardRef):
        return eval(written(annotation), {}, Names(names))
    return annotation


@functools.cache
def fields_of(kind: type) -> dict[str, Any]:
    """Types of the fields of a named tuple that have a shape."""
    names = vars(sys.modules[kind.__module__])
    annotations = getattr(kind, "__annotations__", {})
    return {name: evaluate(hint, names) for name, hint in annotations.items() if SHAPED in written(hint)}


def is_shape(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, AbstractArray)


def agrees(value: Any, hint: Any) -> bool:
    """Whether a value, and the tensors in it, are what a type says; within one call, names keep their sizes."""
    if hint is Any:
        return True
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return value is None or any(agrees(value, member) for member in inner)
    if isinstance(value, Tensor):
        return isinstance(value, hint) if isinstance(hint, type) and origin is None else False
    if is_shape(hint):
        return (
            True  # a number or a list where a tensor would do: what goes in is converted, and says so itself
        )
    if origin is tuple and isinstance(value, tuple):
        hints = [inner[0]] * len(value) if inner[1:] == (...,) else inner
        return len(value) == len(hints) and all(map(agrees, value, hints))
    if isinstance(origin, type) and issubclass(origin, Mapping) and isinstance(value, Mapping):
        return all(agrees(item, inner[1]) for item in value.values())
    if isinstance(origin, type) and issubclass(origin, Iterable) and isinstance(value, Sequence):
        return isinstance(value, str) or all(agrees(item, inner[0]) for item in value)
    if isinstance(hint, type) and isinstance(value, tuple) and isinstance(value, hint):
        return all(agrees(getattr(value, name), field) for name, field in fields_of(hint).items())
    return True


def described(value: Any) -> str:
    """A value for an error message: kind and shape of tensors."""
    if isinstance(value, Tensor):
        return f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}"
    if isinstance(value, tuple | list):
        return f"({', '.join(map(described, value))})"
    return repr(value)


@functools.cache
def holder(kind: type) -> type | None:
    """What values of a type are to ``looks``: a tensor, or a mapping or sequence of values; None for all others."""
    return next((base for base in (Tensor, Mapping, tuple, list) if issubclass(kind, base)), None)


def looks(values: Iterable[Any], deepest: int = 6) -> list[Any]:
    """All that a check looks at of values, in a row: of tensors kind and shape, of others what they are.

    Lists of damaged files may hold themselves, so there is an end to it. It is asked of every call of the package.
    """
    row: list[Any] = []
    for value in values:
        kind = type(value)
        held = holder(kind)
        if held is Tensor:
            row += value.dtype, value.shape
        elif held is None or not deepest:
            row.append(kind)
        else:
            parts = value.values() if held is Mapping else value
            row += kind, len(value), *looks(parts, deepest - 1)
    return row


class Contract:
    """What the annotations of a function say about tensors, read when it is called for the first time."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self.signature = inspect.signature(function)
        self.kept: set[Any] = set()  # calls that looked the same were right

    @functools.cached_property
    def hints(self) -> dict[str, Any]:
        """Types of arguments that have a shape, and of what is returned."""
        names = self.function.__globals__
        return {
            name: evaluate(annotation, names)
            for name, annotation in self.function.__annotations__.items()
            if SHAPED in written(annotation) or (name == "return" and written(annotation).isidentifier())
        }

    def check(self, args: tuple[Any, ...], kwargs: dict[str, Any], result: Any) -> None:
        """Raise ``AnnotationError`` if a call contradicts the annotations."""
        if torch.compiler.is_compiling():
            return
        call = (len(args), *kwargs, *looks((*args, *kwargs.values(), result)))
        if call in self.kept:
            return
        given = self.signature.bind(*args, **kwargs).arguments
        with jaxtyped("context"):
            for name, value in {**given, "return": result}.items():
                several = (
                    name in given and self.signature.parameters[name].kind is inspect.Parameter.VAR_POSITIONAL
                )
                hint = self.hints.get(name, Any)
                if not agrees(value, tuple[hint, ...] if several else hint):
                    raise AnnotationError(
                        f"{self.function.__module__}.{self.function.__qualname__}: {name} is {described(value)}, "
                        f"which contradicts {self.function.__annotations__[name]} where the other arguments are "
                        f"{ {other: described(value) for other, value in given.items() if other in self.hints} }"
                    )
        self.kept.add(call)


def has_shapes(function: types.FunctionType) -> bool:
    """Whether annotations of a function, or the fields of the named tuple that it returns, have shapes."""
    if any(SHAPED in written(annotation) for annotation in function.__annotations__.values()):
        return True
    returned = function.__globals__.get(written(function.__annotations__.get("return", "")))
    return isinstance(returned, type) and issubclass(returned, tuple) and bool(fields_of(returned))


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that calls another one and then compares the call with its annotations, where these have shapes."""
    inner = inspect.unwrap(function)
    if not inspect.isfunction(inner) or not has_shapes(inner):
        return function
    check = Contract(inner).check

    def call(*args: Any, **kwargs: Any) -> Any:
        result = function(*args, **kwargs)
        check(args, kwargs, result)
        return result

    # With the globals of the function's module, where doctest and pickle look for it, and with code of its own, for
    # which torch.compile keeps what it has compiled.
    code = call.__code__.replace(co_name=inner.__name__)
    wrapper = types.FunctionType(code, inner.__globals__, inner.__name__, None, call.__closure__)
    return functools.update_wrapper(wrapper, function)


def check_class(kind: type) -> None:
    """Have the public methods of a class checked, its constructor included; of a named tuple the fields are checked."""
    if issubclass(kind, tuple):  # whose methods torch.compile traces only if they are as they were written
        return
    for name, value in list(vars(kind).items()):
        if name.startswith("_") and name not in ("__init__", "__call__"):
            continue
        if isinstance(value, property) and value.fget is not None:
            new: Any = property(checked(value.fget), value.fset, value.fdel, value.__doc__)
        elif isinstance(value, staticmethod | classmethod):
            new = type(value)(checked(value.__func__))
        elif inspect.isfunction(value):
            new = checked(value)
        elif name == "functions":  # the pure functions of a camera model
            new = tuple(map(checked, value))
        else:
            continue
        setattr(kind, name, new)


def check_module(module: types.ModuleType) -> None:
    """Have the functions and classes checked that a module defines for others."""
    for name, found in list(vars(module).items()):
        if name.startswith("_") or getattr(found, "__module__", None) != module.__name__:
            continue
        if inspect.isclass(found):
            check_class(found)
        elif inspect.isfunction(found):
            setattr(module, name, checked(found))


class CheckingLoader(SourceFileLoader):
    """Runs a module and has its functions checked before anybody else can import them."""

    def exec_module(self, module: types.ModuleType) -> None:
        super().exec_module(module)
        check_module(module)


class CheckedImports(MetaPathFinder):
    """Finds the modules of the package for the ``CheckingLoader``."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> ModuleSpec | None:
        if not name.startswith(f"{PACKAGE}.") or name.startswith(LEFT_OUT):
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is None or not isinstance(spec.loader, SourceFileLoader):
            return spec
        spec.loader = CheckingLoader(spec.loader.name, spec.loader.path)
        return spec


def install() -> None:
    """Check all of the package that is imported from here on."""
    early = sorted(name for name in sys.modules if name.startswith(f"{PACKAGE}."))
    if early:
        raise RuntimeError(f"imported before the shape checks were installed, and so unchecked: {early[:5]}")
    sys.meta_path.insert(0, CheckedImports())
