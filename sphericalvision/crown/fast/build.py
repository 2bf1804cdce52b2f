# SPDX-License-Identifier: Apache-2.0
"""Compiles the operators in C++ in the background, once, and keeps them in the user's cache.

The library is in ``$XDG_CACHE_HOME/sphericalvision`` (``~/.cache/sphericalvision``), a folder that only the user may
write to, under a name that depends on sources, torch, compiler and processor. It is code that will run, so files that
others own or could have written are not loaded. Its digest is next to it, because loading a file that was cut short
would end the process. Such files are compiled again.
"""

from __future__ import annotations

import atexit
import hashlib
import logging
import os
import platform
import shutil
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import IO

import torch

from sphericalvision.core import MissingCompilerError

SOURCES = [Path(__file__).with_name(name) for name in ("hex_convolution.cpp", "normalization.cpp")]
HEADERS = [Path(__file__).with_name(name) for name in ("lanes.h", "volumes.h", "winograd_lines.h")]

PATIENCE = 20.0
"""Seconds after the first convolution from which compiling pays: about as long as compiling takes.

How long a process will run is unknown. This rule of the ski rental problem wastes at most the time of one compilation,
and short commands never compile.
"""

BANNER = 5.0
"""Seconds that the first convolution waits for a compiler to print its version."""
COMPILING = 600.0
"""Seconds after which a compiler counts as hanging."""

# What the processor has, as torch names it. Nothing else is asked for, so that machines may share a folder.
_INSTRUCTIONS = {
    "AVX2": ["-mavx2", "-mfma"],
    "AVX512": ["-mavx2", "-mfma", "-mavx512f", "-mavx512bw", "-mavx512dq", "-mavx512vl"],
}
_GAIN = "convolutions on this CPU would be two to five times as fast by operators in C++"

_log = logging.getLogger("sphericalvision")


class _State:
    """Of this process: whether the operators are loaded, and what has been tried."""

    loaded = False
    given_up = False  # nothing more is tried by itself
    first_asked: float | None = None
    compiling: threading.Thread | None = None
    lock = threading.Lock()
    processes: list[subprocess.Popen[str]] = []  # noqa: RUF012
    lock_file: IO[str] | None = None


def operators_ready(way: str, may_load: bool = True) -> bool:
    """Whether operators are to be used in a way of ``kernels``; asked before each of them.

    Args:
        way: the mode of ``kernels``.
        may_load: whether a library that is not loaded yet may be.

    Raises:
        MissingCompilerError: with ``"require"``, if they cannot be had.
    """
    if way not in ("auto", "require"):
        return False
    if _State.loaded or not may_load:
        return _State.loaded
    if way == "require":
        with _State.lock:
            return _State.loaded or _load_or_compile()
    if not _State.given_up and _State.compiling is None:
        _consider()
    return _State.loaded


def _consider() -> None:
    """Load what is in the cache, or begin to compile once that pays."""
    now = time.monotonic()
    if _State.first_asked is None:
        _State.first_asked = now
        try:
            if _is_whole(_library()):
                _load(_library())
        except (OSError, RuntimeError, subprocess.SubprocessError):
            pass  # it is compiled again later, or the reason is logged
        return
    # Results that must not change from run to run must not change within one either.
    if now - _State.first_asked < PATIENCE or torch.are_deterministic_algorithms_enabled():
        return
    _State.compiling = threading.Thread(target=_compile_beside, name="compiles operators", daemon=True)
    _State.compiling.start()


def _compile_beside() -> None:
    start = time.monotonic()
    try:
        folder = _folder()
        _compiler()
        _log.warning(
            "compiling faster operators in C++ beside the work, once, into %s (a minute or less)", folder
        )
        with _State.lock:
            _load_or_compile("nice", "-n", "10")
        _log.warning("operators in C++ are used from here on, after %.0f s", time.monotonic() - start)
    except (OSError, RuntimeError) as error:
        _State.given_up = True
        _log.warning("%s: %s", _GAIN, error)


def _load_or_compile(*before: str) -> bool:
    """Load the library, after compiling it if it is missing or damaged; ``before`` precedes the compiler's command."""
    try:
        library = _library()
        with _alone(library.parent):
            if not _is_whole(library):
                _compile(library, list(before) if before and shutil.which(before[0]) else [])
            try:
                _load(library)
            except (OSError, RuntimeError):  # of another torch with the same version and configuration
                _compile(library, [])
                _load(library)
    except (OSError, RuntimeError, subprocess.SubprocessError) as error:
        if isinstance(error, MissingCompilerError):
            raise
        raise MissingCompilerError(
            f"the C++ operators could not be built: {error}. They need a C++ compiler, such as g++ (CXX names "
            "another), and a folder to write to (XDG_CACHE_HOME names another than ~/.cache); without them everything "
            "works, only slower"
        ) from error
    return True


def _load(library: Path) -> None:
    torch.ops.load_library(library)
    _State.loaded = True


def _folder() -> Path:
    """The folder of the library, which only this user may write to."""
    named = os.environ.get("XDG_CACHE_HOME")
    try:
        folder = (Path(named) if named else Path.home() / ".cache") / "sphericalvision"
    except RuntimeError as error:  # a user without a home
        raise FileNotFoundError(f"{error}; XDG_CACHE_HOME names a folder to write to") from error
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not _is_own(folder.stat(), allowed=stat.S_IFDIR | 0o777):
        raise PermissionError(f"{folder} belongs to somebody else")
    if stat.S_IMODE(folder.stat().st_mode) & 0o077:
        folder.chmod(0o700)
    return folder


def _is_own(found: os.stat_result, allowed: int) -> bool:
    """Whether a file is this user's, and has no bits of its mode but those ``allowed``."""
    return not hasattr(os, "getuid") or (found.st_uid == os.getuid() and not found.st_mode & ~allowed)


@cache
def _compiler() -> tuple[str, str]:
    """The compiler and its version."""
    command = os.environ.get("CXX") or "c++"
    found = shutil.which(command)
    if found is None:
        raise MissingCompilerError(
            f"the C++ operators need a C++ compiler, such as g++; {command} was not found (CXX names another)"
        )
    try:
        banner = subprocess.run([found, "--version"], capture_output=True, timeout=BANNER)
    except (OSError, subprocess.SubprocessError) as error:
        raise MissingCompilerError(
            f"the C++ compiler {found} does not run: {error} (CXX names another)"
        ) from error
    return found, banner.stdout.decode(errors="replace")  # in whatever encoding the user has


def _flags() -> list[str]:
    threads = [] if sys.platform == "darwin" else ["-fopenmp"]
    abi = f"-D_GLIBCXX_USE_CXX11_ABI={int(torch._C._GLIBCXX_USE_CXX11_ABI)}"
    return [
        "-O3",
        "-std=c++20",
        "-fPIC",
        abi,
        *threads,
        *_INSTRUCTIONS.get(torch.backends.cpu.get_cpu_capability(), []),
    ]


def _library() -> Path:
    """Where the library is or will be; its name follows from all that it depends on."""
    machine = [sys.platform, platform.machine(), *platform.libc_ver()]
    code = [path.read_text() for path in SOURCES + HEADERS]
    parts = [*code, torch.__version__, torch.__config__.show(), *machine, *_compiler(), *_flags()]
    return _folder() / f"operators_{hashlib.sha256(chr(10).join(parts).encode()).hexdigest()[:16]}.so"


def _digest_file(library: Path) -> Path:
    return library.with_suffix(".sha256")


def _is_whole(library: Path) -> bool:
    """Whether the library is there as it was written, by this user."""
    try:
        with library.open("rb") as file:
            own = _is_own(os.fstat(file.fileno()), allowed=stat.S_IFREG | 0o755)
            digest = hashlib.sha256(file.read()).hexdigest()
        return own and _digest_file(library).read_text() == digest
    except (OSError, UnicodeDecodeError):
        return False


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """One process at a time compiles; others wait and find what it made."""
    with (folder / "lock").open("w") as lock:
        if sys.platform == "win32":
            yield
            return
        import fcntl

        fcntl.flock(lock, fcntl.LOCK_EX)
        _State.lock_file = lock
        try:
            yield
        finally:
            _State.lock_file = None
            fcntl.flock(lock, fcntl.LOCK_UN)  # a child that was forked meanwhile has the file open, too


def _compile(library: Path, before: list[str]) -> None:
    """Write the library and its digest, by which a file that did not reach the disk whole is noticed."""
    root = Path(torch.__file__).parent
    headers = root / "include"
    include = ["-isystem", str(headers), "-isystem", str(headers / "torch" / "csrc" / "api" / "include")]
    undefined = ["-undefined", "dynamic_lookup"] if sys.platform == "darwin" else []
    compiler, _ = _compiler()
    with tempfile.TemporaryDirectory(dir=library.parent) as name:
        objects = [Path(name) / f"{source.stem}.o" for source in SOURCES]
        built = Path(name) / library.name
        _run_all(
            [*before, compiler, *_flags(), *include, "-c", str(source), "-o", str(to)]
            for source, to in zip(SOURCES, objects, strict=True)
        )
        # Threads are those of torch, in the one OpenMP that it has loaded.
        libraries = [f"-L{root / 'lib'}", "-ltorch_cpu", "-lc10", *undefined]
        _run_all([[compiler, "-shared", *map(str, objects), *libraries, "-o", str(built)]])
        digest = Path(name) / "digest"
        digest.write_text(hashlib.sha256(built.read_bytes()).hexdigest())
        for path, to in ((built, library), (digest, _digest_file(library))):
            path.chmod(0o700)  # whatever others may do by the umask
            path.replace(to)


def _run_all(commands: Iterator[list[str]] | list[list[str]]) -> None:
    """Run commands side by side."""
    _State.processes = [
        subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, errors="replace"
        )
        for command in commands
    ]
    try:
        outputs = [process.communicate(timeout=COMPILING)[1] for process in _State.processes]
    except subprocess.TimeoutExpired as error:
        _stop_compiling()
        raise RuntimeError(f"{error.args[0]!r:.100} did not end within {COMPILING:.0f} s") from None
    for process, output in zip(_State.processes, outputs, strict=True):
        if process.returncode:
            lines = output.splitlines() or [f"{process.args!r} ended with {process.returncode}"]
            raise RuntimeError(next((line for line in lines if "error" in line), lines[0])[:300])
    _State.processes = []


def _begin_anew() -> None:
    """In a child that was forked while a thread compiled: the thread, its lock and its compilers are the parent's."""
    _State.lock, _State.compiling, _State.processes = threading.Lock(), None, []
    if _State.lock_file is not None:  # or the child would wait for itself
        _State.lock_file.close()
        _State.lock_file = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_anew)


@atexit.register
def _stop_compiling() -> None:
    for process in _State.processes:
        process.kill()
