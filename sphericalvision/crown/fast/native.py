# SPDX-License-Identifier: Apache-2.0
"""Operators in C++, built by torch with the machine's compiler when they are first asked for."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from sphericalvision.core import MissingCompilerError

__all__ = ["native_at_hand", "native_operators"]

SOURCES = [
    Path(__file__).with_name(name) for name in ("hex_convolution.cpp", "hex_direct.cpp", "normalization.cpp")
]
HEADERS = [Path(__file__).with_name(name) for name in ("lanes.h", "volumes.h", "winograd_lines.h")]

# What the processor has, as torch names it. Nothing else is asked for, so that machines may share a folder.
_INSTRUCTIONS = {
    "AVX2": ["-mavx2", "-mfma"],
    "AVX512": ["-mavx2", "-mfma", "-mavx512f", "-mavx512bw", "-mavx512dq", "-mavx512vl"],
}


@lru_cache(maxsize=1)
def native_operators() -> Any:
    """Return the operators of all ``SOURCES``, for tensors on the CPU.

    The first call on a machine compiles them into the folder where torch keeps its
    extensions (``TORCH_EXTENSIONS_DIR``); later processes load them from there.

    Raises:
        MissingCompilerError: there is no C++ compiler or no ninja, or they fail.
    """
    library = _folder() / f"sphericalvision_{_fingerprint()}.so"
    if library.exists():
        torch.ops.load_library(library)
    else:
        _build(library)
    return torch.ops.sphericalvision


def native_at_hand() -> bool:
    """Whether the operators have been compiled on this machine, and load: nothing has to be waited for."""
    try:
        if (_folder() / f"sphericalvision_{_fingerprint()}.so").is_file():
            native_operators()
            return True
    except (MissingCompilerError, OSError, RuntimeError):
        pass
    return False


def _folder() -> Path:
    named = os.environ.get("TORCH_EXTENSIONS_DIR")
    return Path(named) if named else Path.home() / ".cache" / "torch_extensions"


def _flags() -> list[str]:
    threads = [] if sys.platform == "darwin" else ["-fopenmp"]
    return ["-O3", "-std=c++20", *threads, *_INSTRUCTIONS.get(torch.backends.cpu.get_cpu_capability(), [])]


def _fingerprint() -> str:
    """Of all that the library depends on."""
    machine = [sys.platform, platform.machine(), *platform.libc_ver()]
    code = [path.read_text() for path in SOURCES + HEADERS]
    parts = [*code, torch.__version__, torch.__config__.show(), *machine, *_flags()]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def _build(library: Path) -> None:
    """Compile and load; the file is moved into place when it is whole."""
    try:
        from torch.utils import cpp_extension  # takes long and needs setuptools: only who builds pays for it

        library.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=library.parent) as folder, _with_ninja():
            cpp_extension.load(
                library.stem,
                [str(path) for path in SOURCES],
                extra_cflags=_flags(),
                build_directory=folder,
                is_python_module=False,
            )
            (built,) = Path(folder).glob(f"{library.stem}*")
            os.replace(built, library)
    except (ImportError, OSError, RuntimeError, ValueError) as error:
        raise MissingCompilerError(
            f"native: the C++ operators could not be built: {_reason(error)}. They need a C++ compiler, such as g++, "
            f"ninja (`pip install 'sphericalvision[native]'`) and a folder to write to (TORCH_EXTENSIONS_DIR, now "
            f"{library.parent}); without native everything works, only slower"
        ) from error


def _reason(error: Exception) -> str:
    """The line of a compiler's output that matters."""
    lines = str(error).splitlines() or [type(error).__name__]
    return next((line for line in lines if "error:" in line or "not found" in line), lines[0])[:300]


@contextmanager
def _with_ninja() -> Iterator[None]:
    """Let torch find the ninja of this Python's environment, also where that is not activated."""
    before = os.environ.get("PATH", "")
    os.environ["PATH"] = os.pathsep.join((before, str(Path(sys.executable).parent)))
    try:
        yield
    finally:
        os.environ["PATH"] = before
