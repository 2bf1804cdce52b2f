# SPDX-License-Identifier: Apache-2.0
"""Where operators come from: compiled beside the work or waited for, kept in a cache that is checked."""

import logging
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from sphericalvision.core import MissingCompilerError
from sphericalvision.crown import HexConv2d
from sphericalvision.crown.fast import build
from sphericalvision.kernels import kernels

V = 12


def no_home(*_: Any) -> Path:
    raise RuntimeError("Could not determine home directory.")


class Fresh(build._State):
    """As in a process that has not asked yet."""

    loaded, given_up, first_asked, compiling = False, False, None, None
    lock = threading.Lock()
    processes: list[Any] = []  # noqa: RUF012


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A cache of its own, and operators that are one empty library."""
    made: list[Path] = []
    source = tmp_path / "nothing.cpp"
    source.write_text("int nothing() { return 0; }")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(build, "SOURCES", [source])
    monkeypatch.setattr(build, "_State", Fresh)
    for name in ("loaded", "given_up", "first_asked", "compiling"):
        monkeypatch.setattr(Fresh, name, getattr(build._State, name))

    def load(library: Path) -> None:
        made.append(library)
        Fresh.loaded = True

    monkeypatch.setattr(build, "_load", load)
    forget = build._compiler.cache_clear
    forget()
    yield tmp_path / "cache" / "sphericalvision"
    forget()


@pytest.fixture
def compiles(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Commands, none of which is run: each writes what it is asked for."""
    commands: list[list[str]] = []

    def run(some: Any) -> None:
        for command in some:
            commands.append(command)
            Path(command[command.index("-o") + 1]).write_text("whole")

    monkeypatch.setattr(build, "_run_all", run)
    monkeypatch.setattr(build, "_compiler", lambda: ("c++", "some compiler 1.0"))
    return commands


def test_required_operators_are_waited_for_and_kept(cache: Path, compiles: list[list[str]]) -> None:
    cache.mkdir(0o755, parents=True)  # nobody else may look into it later
    assert build.operators_ready("require")
    assert len(compiles) == 2  # one source, and the library
    assert cache.stat().st_mode & 0o777 == 0o700
    Fresh.loaded = False
    assert build.operators_ready("require")
    assert len(compiles) == 2


def test_a_damaged_or_stale_file_is_made_anew(
    cache: Path, compiles: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    build.operators_ready("require")
    (library,) = cache.glob("*.so")
    library.write_text("damaged")
    Fresh.loaded = False
    build.operators_ready("require")
    assert len(compiles) == 4
    assert library.read_text() == "whole"
    monkeypatch.setattr(build, "_compiler", lambda: ("c++", "some compiler 2.0"))
    Fresh.loaded = False
    build.operators_ready("require")
    assert len(list(cache.glob("*.so"))) == 2


@pytest.mark.parametrize("change", ["shorter", "others may write", "of somebody else"])
def test_a_library_that_may_not_be_ours_is_made_anew(
    cache: Path, compiles: list[list[str]], monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    """In ``auto``, too, it is not even opened by the loader; a file that is cut short would end the process."""
    before = os.umask(0o002)  # of many systems: a group may write what is made
    build.operators_ready("require")
    os.umask(before)
    (library,) = cache.glob("*.so")
    if change == "shorter":
        library.write_text("who")
    elif change == "others may write":
        library.chmod(0o777)
    else:  # the folder is ours by now, but somebody put a file into it before
        true, cheat = os.fstat, os.stat_result((0o100644, 0, 0, 1, os.getuid() + 1, 0, 3, 0, 0, 0))
        monkeypatch.setattr(build.os, "fstat", lambda file: cheat if len(compiles) == 2 else true(file))
    Fresh.loaded = False
    assert not build.operators_ready("auto")
    assert build.operators_ready("require")
    assert len(compiles) == 4
    assert library.stat().st_mode & 0o022 == 0
    assert library.read_text() == "whole"


def test_compiling_begins_beside_the_work_once_it_pays(
    cache: Path, compiles: list[list[str]], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    now = [100.0]
    monkeypatch.setattr(build.time, "monotonic", lambda: now[0])
    with caplog.at_level(logging.WARNING, "sphericalvision"):
        for step in (0, 1, build.PATIENCE - 2):  # a command that ends sooner never compiles
            now[0] += step
            assert not build.operators_ready("auto")
        assert Fresh.compiling is None
        assert not caplog.messages
        now[0] += 2
        build.operators_ready("auto")
        assert Fresh.compiling is not None
        Fresh.compiling.join()
    assert build.operators_ready("auto")
    assert len(caplog.messages) == 2
    assert "beside the work" in caplog.messages[0]
    for way in ("plain", "reference"):
        assert not build.operators_ready(way)


@pytest.mark.parametrize("missing", ["compiler", "working compiler", "folder", "home"])
def test_without_a_compiler_or_a_cache_everything_works_and_one_line_says_what_would_be_gained(
    cache: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, missing: str
) -> None:
    if missing == "compiler":
        monkeypatch.setenv("CXX", "no-such-compiler")
    elif missing == "working compiler":
        monkeypatch.setenv("CXX", "false")
    elif missing == "home":
        monkeypatch.delenv("XDG_CACHE_HOME")
        monkeypatch.setattr(Path, "home", no_home)
    else:
        cache.parent.write_text("a file in the place of the folder")
    monkeypatch.setattr(build, "PATIENCE", 0.0)
    layer, values = HexConv2d(1, 1), torch.ones(1, 1, V)
    with caplog.at_level(logging.WARNING, "sphericalvision"), kernels("auto"):
        for _ in range(3):
            layer(values)
            if Fresh.compiling is not None:
                Fresh.compiling.join()
    lines = [message for message in caplog.messages if "beside the work" not in message]
    assert len(lines) == 1
    assert "as fast" in lines[0]
    assert "\n" not in lines[0]
    with (
        kernels("require"),
        pytest.raises(MissingCompilerError, match=r"C\+\+ compiler.*(CXX|XDG_CACHE_HOME)"),
    ):
        layer(values)


def test_what_the_compiler_complains_of_is_told(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "")  # names none, as if it was not set
    build.SOURCES[0].write_text("int nothing( { return 0; }")
    if build.shutil.which("c++") is None:
        pytest.skip("needs a C++ compiler")
    with pytest.raises(MissingCompilerError, match="error: expected"):
        build.operators_ready("require")
    assert not list(cache.glob("*.so"))


def test_nothing_is_compiled_where_results_must_not_change(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build, "PATIENCE", 0.0)
    torch.use_deterministic_algorithms(True)
    try:
        for _ in range(3):
            assert not build.operators_ready("auto")
        assert Fresh.compiling is None
    finally:
        torch.use_deterministic_algorithms(False)
