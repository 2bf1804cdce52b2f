# SPDX-License-Identifier: Apache-2.0
"""Checks and errors.

Every error of this package is a ``SphericalVisionError`` and also the built-in error that a Python user would
expect, so ``except ValueError`` and ``except SphericalVisionError`` both work.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache, wraps
from importlib.util import find_spec
from pathlib import Path
from reprlib import Repr
from typing import Any, ParamSpec, TypeVar

import torch
from torch.utils._python_dispatch import _disable_current_modes
from torch.utils._pytree import tree_leaves, tree_map_only

__all__ = [
    "ArgumentError",
    "ArgumentTypeError",
    "FileFormatError",
    "MissingCompilerError",
    "MissingFileError",
    "ShapeError",
    "SphericalVisionError",
    "kernels",
    "reference_kernels",
]


class SphericalVisionError(Exception):
    """Base of every error raised on purpose by this package.

    Examples:
        >>> from sphericalvision.icosphere import Icosphere
        >>> try:
        ...     Icosphere(level=-1)
        ... except SphericalVisionError as error:
        ...     print(error)
        level: expected an integer from 0 (icosahedron) to 10 (ten million vertices), got -1
    """


class ArgumentError(SphericalVisionError, ValueError):
    """An argument has a value that makes no sense; the message names it and the accepted values.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> ring_rig(4, radius=-1)
        Traceback (most recent call last):
        sphericalvision.core.ArgumentError: radius: expected metres above 0, got -1
        >>> issubclass(ArgumentError, ValueError)
        True
    """


class ArgumentTypeError(ArgumentError, TypeError):
    """An argument is of another type than the docstring asks for; the message says which, and what makes one.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.scenes import make_scene, render_rig
        >>> render_rig(make_scene("room"), "rig.yaml")
        Traceback (most recent call last):
        sphericalvision.core.ArgumentTypeError: rig: expected a CameraRig, got 'rig.yaml'; ring_rig makes one, read_rig
        reads one
    """


class ShapeError(SphericalVisionError, ValueError):
    """A tensor has another shape than the docstring asks for; the message says both.

    Examples:
        >>> from sphericalvision.icosphere import Icosphere
        >>> Icosphere(level=1).sample(torch.zeros(3, 40), torch.eye(3))
        Traceback (most recent call last):
        sphericalvision.core.ShapeError: values: expected shape (*b, c, 42) for an icosphere of level 1, got (3, 40)
    """


class FileFormatError(SphericalVisionError, ValueError):
    """A file exists but does not hold what its format promises; the message names file and line or key.

    If a message quotes very long content of a damaged file, its middle is left out.

    Examples:
        >>> from sphericalvision.cameras import read_cameras
        >>> _ = Path("notes.yaml").write_text("lens: new")
        >>> read_cameras("notes.yaml")
        Traceback (most recent call last):
        sphericalvision.core.FileFormatError: notes.yaml: not a calibration; known are ...
    """

    def __init__(self, message: str = "") -> None:
        super().__init__(_without_middle(message))


class MissingFileError(SphericalVisionError, FileNotFoundError):
    """A file or folder is missing; the message names it, without the middle of a long name, and what was expected.

    Examples:
        >>> from sphericalvision.cameras import read_rig
        >>> read_rig("nowhere.yaml")
        Traceback (most recent call last):
        sphericalvision.core.MissingFileError: nowhere.yaml: no such file or folder (a calibration was expected; ...)
        >>> issubclass(MissingFileError, FileNotFoundError)
        True
    """

    def __init__(self, message: str = "") -> None:
        super().__init__(_without_middle(message))


def _without_middle(message: str, longest: int = 2000) -> str:
    return message if len(message) <= longest else f"{message[: longest - 500]} ... {message[-495:]}"


class MissingCompilerError(SphericalVisionError, RuntimeError):
    """Code could not be compiled on this machine; the message says what is needed.

    Examples:
        >>> issubclass(MissingCompilerError, RuntimeError)
        True
    """


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, or its class where it has none, for the message of another.

    Examples:
        >>> first_line(ValueError("no header\\nat byte 0")), first_line(KeyError())
        ('no header', 'KeyError')
    """
    return (str(error).splitlines() or [type(error).__name__])[0]


def short_repr(value: Any) -> str:
    """Show any value in an error message in at most 200 characters, whatever it holds.

    A file of a few hundred bytes can hold lists whose full text would fill the memory (YAML's aliases); only what is
    shown is looked at.

    Examples:
        >>> short_repr({"model": "ocam", "poly": list(range(100))})
        "{'model': 'ocam', 'poly': [0, 1, 2, 3, 4, 5, 6, 7, ...]}"
    """
    try:
        text = _SHORT.repr(value)
    except ValueError:  # of integers with thousands of digits, which Python does not turn into text
        text = f"a huge {type(value).__name__}"
    return text if len(text) <= 200 else f"{text[:196]} ..."


_SHORT = Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 3, 100, 100
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = _SHORT.maxset = _SHORT.maxfrozenset = 8


def check_type(name: str, value: Any, kind: type | tuple[type, ...], remedy: str = "") -> None:
    """Raise ``ArgumentTypeError`` unless ``value`` is of a type, or one of several; ``remedy`` says what makes one.

    Examples:
        >>> check_type("level", 5, int)
    """
    if not isinstance(value, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        names = " or ".join(f"{'an' if k.__name__[0] in 'AEIOU' else 'a'} {k.__name__}" for k in kinds)
        got = short_repr(value) if isinstance(value, str | int | float | None) else type(value).__name__
        raise ArgumentTypeError(f"{name}: expected {names}, got {got}{remedy and '; '}{remedy}")


def check_tensor(name: str, value: Any, shape: str) -> None:
    """Raise ``ArgumentTypeError`` unless ``value`` is a tensor; ``shape`` says which one, and is shown alone.

    Examples:
        >>> check_tensor("images", torch.zeros(2, 3, 4, 4), "(B, 3, h, w)")
    """
    if isinstance(value, torch.Tensor):
        return
    kind, size = type(value), getattr(value, "shape", None)
    got = (
        kind.__name__
        if size is None
        else f"{kind.__module__.partition('.')[0]}.{kind.__name__} {tuple(size)}"
    )
    makes = {
        "ndarray": "; torch.from_numpy makes one, with channels before height and width",
        "list": "; torch.tensor makes one",
        "tuple": "; torch.tensor makes one",
        "Crown": "; from_crown makes one",
    }.get(kind.__name__, "")
    raise ArgumentTypeError(f"{name}: expected a torch.Tensor of shape {shape}, got {got}{makes}")


def check_floating(name: str, tensor: torch.Tensor) -> None:
    """Raise ``ArgumentError`` unless a tensor holds floating point numbers.

    Examples:
        >>> check_floating("points", torch.zeros(4, 3))
    """
    if not tensor.is_floating_point():
        raise ArgumentError(
            f"{name}: expected floating point values, got {tensor.dtype}; convert them with .float()"
        )


def check_dtype(name: str, values: torch.Tensor, weight: torch.Tensor) -> None:
    """Raise ``ArgumentError`` unless values are of the type of the weights that they meet, or autocast sees to it.

    Examples:
        >>> check_dtype("values", torch.zeros(1, 3, 42), torch.nn.Conv1d(3, 8, 1).weight)
    """
    if values.dtype == weight.dtype:
        return
    casts = values.device.type != "meta" and torch.is_autocast_enabled(values.device.type)
    if casts and values.is_floating_point() and values.dtype != torch.float64:
        return
    kind = str(weight.dtype).removeprefix("torch.")
    raise ArgumentError(
        f"{name}: expected {weight.dtype} as the weights have, got {values.dtype}; convert them with "
        f".to(torch.{kind}), or the module with .to({values.dtype})"
    )


def check_counts(**numbers: int) -> None:
    """Raise ``ArgumentError`` unless all of these are whole numbers of 1 or more.

    Examples:
        >>> check_counts(in_channels=3, out_channels=8)
    """
    for name, number in numbers.items():
        if isinstance(number, bool) or not isinstance(number, int) or number < 1:
            raise ArgumentError(f"{name}: expected a whole number of 1 or more, got {short_repr(number)}")


def check_last_dim(name: str, tensor: torch.Tensor, size: int) -> None:
    """Raise ``ShapeError`` unless ``tensor`` is a tensor of shape ``(*, size)``.

    Examples:
        >>> check_last_dim("points", torch.zeros(4, 3), 3)
    """
    check_tensor(name, tensor, f"(*, {size})")
    if tensor.ndim == 0 or tensor.shape[-1] != size:
        raise ShapeError(f"{name}: expected shape (*, {size}), got {tuple(tensor.shape)}")


def check_choice(name: str, value: object, choices: tuple[object, ...]) -> None:
    """Raise ``ArgumentError`` that lists the choices unless ``value`` is one of them.

    Examples:
        >>> check_choice("mode", "nearest", ("bilinear", "nearest"))
    """
    if value not in choices:
        raise ArgumentError(f"{name}: expected one of {', '.join(map(repr, choices))}, got {value!r}")


def check_file(path: str | Path, what: str) -> Path:
    """Return ``path`` as a ``Path`` or raise ``MissingFileError`` saying what was expected there."""
    path = Path(path)
    if not os.path.isfile(path):  # False, too, for names that no file can have, where pathlib raises
        folder = path.parent.absolute()
        near = (
            f"looked in {folder}" if os.path.exists(folder) else f"the folder {folder} does not exist either"
        )
        raise MissingFileError(f"{path}: no such file ({what} expected; {near})")
    return path


KERNELS = ("auto", "plain", "graph", "reference", "require")


class _Block:
    """An open ``kernels`` block, equal to itself alone."""

    def __init__(self, way: str) -> None:
        self.way = way


_open_blocks: list[_Block] = []
"""Of all threads. It is appended to and removed from, which are one step each: none is lost, and none stays."""


@contextmanager
def kernels(way: str) -> Iterator[None]:
    """Choose how everything inside is computed; the numbers are the same but for rounding.

    ``"auto"``
        As outside of all blocks: by operators in C++ where they can be had, which are compiled beside the work.
    ``"plain"``
        By layers in torch alone, as ``"auto"`` does where there is no compiler.
    ``"graph"``
        By few large operators of torch, as ``"auto"`` does on a device that is not a CPU, in ``torch.compile`` and in
        exported programs.
    ``"reference"``
        By the readable formulas alone, which are differentiable any number of times.
    ``"require"``
        By operators in C++ wherever they can at all, in double precision, too; they are waited for.

    The environment variable ``SPHERICALVISION_KERNELS`` chooses for a whole process. Blocks count for all threads, and
    may be nested: the one opened last decides.

    Args:
        way: one of these.

    Raises:
        ArgumentError: another way.
        MissingCompilerError: with ``"require"``, inside, if there are no operators and they cannot be compiled.

    Examples:
        >>> with kernels("reference"):
        ...     with kernels("plain"):
        ...         way_of_kernels()
        'plain'
    """
    check_choice("kernels", way, KERNELS)
    block = _Block(way)
    _open_blocks.append(block)
    try:
        yield
    finally:
        _open_blocks.remove(block)


def reference_kernels() -> AbstractContextManager[None]:
    """Compute everything inside by the readable formulas, without the faster ways to the same numbers.

    Short for ``kernels("reference")``: for comparison, and for derivatives of any order.

    Examples:
        >>> with reference_kernels():
        ...     uses_reference_kernels()
        True
    """
    return kernels("reference")


def way_of_kernels() -> str:
    """Return the way of ``kernels`` that is in force."""
    with suppress(IndexError):  # there is none, or another thread has just closed the last one
        return _open_blocks[-1].way
    way = os.environ.get("SPHERICALVISION_KERNELS") or "auto"
    check_choice("SPHERICALVISION_KERNELS", way, KERNELS)
    return way


def uses_reference_kernels() -> bool:
    """Whether the readable formulas are asked for."""
    return way_of_kernels() == "reference"


P = ParamSpec("P")
R = TypeVar("R")


def full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function compute in the precision of what it is given, inside of ``torch.autocast`` too.

    For geometry: products of matrices in bfloat16 would move pixels and triangles.

    Examples:
        >>> @full_precision
        ... def product(a, b):
        ...     return a @ b
        >>> with torch.autocast("cpu", torch.bfloat16):
        ...     product(torch.ones(2, 2), torch.ones(2, 2)).dtype
        torch.float32
    """

    @wraps(function)
    def exact(*args: P.args, **kwargs: P.kwargs) -> R:
        device = next((kind for kind in ("cpu", "cuda", "mps") if torch.is_autocast_enabled(kind)), None)
        if device is None:
            return function(*args, **kwargs)
        with torch.autocast(device, enabled=False):
            return exact(*args, **kwargs)

    return exact


def in_one_graph(device: torch.device) -> bool:
    """Whether what runs on a device is to be one graph: few large operators, none of which waits for values.

    So it is on anything but a CPU, which a host would have to feed otherwise; for who compiles or exports; and within
    ``kernels("graph")``. On a CPU loops over samples and cameras pay, as what belongs together stays in its cache, and
    so do steps that only look at what is left to be done.

    Examples:
        >>> in_one_graph(torch.device("cpu")), in_one_graph(torch.device("cuda"))
        (False, True)
    """
    way = way_of_kernels()
    return way == "graph" or (way != "reference" and (device.type != "cpu" or torch.compiler.is_compiling()))


@cache
def runs_triton(device: torch.device) -> bool:
    """Whether kernels in Triton run on a device: on NVIDIA's from Volta on, with Triton and a C compiler at hand.

    Triton comes with torch for CUDA on Linux; what starts a kernel it compiles by ``CC``, gcc or clang.

    Examples:
        >>> runs_triton(torch.device("cpu"))
        False
    """
    if device.type != "cuda" or find_spec("triton") is None:
        return False
    compilers = os.environ.get("CC") or "gcc", "gcc", "clang"
    return any(map(shutil.which, compilers)) and torch.cuda.get_device_capability(device) >= (7, 0)


def by_triton(*tensors: torch.Tensor, differentiable: bool = False) -> bool:
    """Whether kernels in Triton compute what is made of tensors: on CUDA devices, where nobody asks for derivatives.

    Compilers, and programs that leave this package, get operators of torch.

    Args:
        tensors: on one device.
        differentiable: whether there are kernels for derivatives, too.

    Examples:
        >>> by_triton(torch.zeros(3))
        False
    """
    if torch.compiler.is_compiling() or uses_reference_kernels() or not runs_triton(tensors[0].device):
        return False
    differentiated = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    return (differentiable or not differentiated) and not torch._C._are_functorch_transforms_active()


LARGEST_TABLE = 1 << 28
"""Bytes up to which a table is kept: at level 9 of an icosphere nearly all are smaller."""


def constant_table(table: Callable[P, R]) -> Callable[P, R]:
    """Make a function of hashable arguments keep what it returns, tensors that nobody may write to.

    Compilers and exported programs take it for a constant, and a device is not asked twice.
    """
    made: dict[Any, tuple[R]] = {}

    def kept(*args: P.args, **kwargs: P.kwargs) -> tuple[R]:
        key = (
            tuple((type(arg), arg) for arg in (*args, *kwargs.values())),
            tuple(kwargs),
            torch.get_default_dtype(),
            torch.get_default_device(),
        )
        try:
            if key in made:
                return made[key]
        except TypeError:  # a list, say, which the function refuses
            return (table(*args, **kwargs),)
        if torch._C._are_functorch_transforms_active():  # inside of which tensors do not outlive them
            return (table(*args, **kwargs),)
        # Real tensors, of use where gradients are wanted, whoever records or counts operators just now. They are made
        # on the CPU and moved once: a device that has no values cannot count, and others would be waited for.
        device = next((arg for arg in (*args, *kwargs.values()) if isinstance(arg, torch.device)), None)
        cpu = torch.device("cpu")
        with _disable_current_modes(), torch.inference_mode(False), torch.no_grad():
            on_cpu: Any = [cpu if arg is device else arg for arg in args] if device else args
            named: Any = {k: cpu if arg is device else arg for k, arg in kwargs.items()} if device else kwargs
            result = table(*on_cpu, **named)
            if device is not None:
                result = tree_map_only(torch.Tensor, lambda tensor: tensor.to(device), result)
        tensors = [leaf for leaf in tree_leaves(result) if isinstance(leaf, torch.Tensor)]
        for tensor in tensors:
            # As `torch._dynamo.mark_static`, whose import takes seconds: what has another size at each level is not
            # what compilers should take for something that changes.
            tensor.__dict__.update(
                _dynamo_static_indices=set(range(tensor.ndim)), _has_dynamo_dim_marking=True
            )
        if sum(tensor.nbytes for tensor in tensors) <= LARGEST_TABLE:
            made[key] = (result,)
        return (result,)

    def for_now(*args: P.args, **kwargs: P.kwargs) -> tuple[R]:
        result = kept(*args, **kwargs)
        fakes = torch._C._get_dispatch_mode(torch._C._TorchDispatchModeKey.FAKE)
        if (
            fakes is not None and not fakes.allow_non_fake_inputs
        ):  # shapes alone, without real tensors among them
            return tree_map_only(torch.Tensor, fakes.from_tensor, result)  # type: ignore[no-any-return]
        return result

    # As `torch.compiler.assume_constant_result`, which imports the compiler: seconds of each start.
    vars(for_now)["_dynamo_marked_constant"] = True

    @wraps(table)
    def constant(*args: P.args, **kwargs: P.kwargs) -> R:
        return for_now(*args, **kwargs)[0]  # compilers give tensors alone one name, where each wants its own

    return constant


def copied(table: Callable[P, torch.Tensor]) -> Callable[P, torch.Tensor]:
    """Make a function return a copy, to be written to, of a tensor that is kept."""

    @wraps(table)
    def copy(*args: P.args, **kwargs: P.kwargs) -> torch.Tensor:
        return table(*args, **kwargs).clone()

    return copy
