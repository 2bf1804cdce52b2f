# SPDX-License-Identifier: Apache-2.0
"""Checks and errors.

Every error of this package is a ``SphericalVisionError`` and also the built-in error that a Python user would
expect, so ``except ValueError`` and ``except SphericalVisionError`` both work.
"""

from __future__ import annotations

import os
from pathlib import Path
from reprlib import Repr
from typing import Any

import torch

__all__ = [
    "ArgumentError",
    "ArgumentTypeError",
    "FileFormatError",
    "MissingCompilerError",
    "MissingFileError",
    "ShapeError",
    "SphericalVisionError",
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
