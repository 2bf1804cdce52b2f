# SPDX-License-Identifier: Apache-2.0
"""What others do beside this package: broken plug-ins, threads, forks, compilers that hang or speak Latin-1."""

import os
import signal
import stat
import threading
import time
import warnings
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import pytest

from sphericalvision import extensions
from sphericalvision import kernels as kernels_module
from sphericalvision.cameras import read_rig, ring_rig, save_rig
from sphericalvision.cameras.calibration import formats
from sphericalvision.core import ArgumentError, MissingCompilerError
from sphericalvision.crown.fast import build
from sphericalvision.kernels import kernel_mode, kernels
from sphericalvision.recipes.app import running

BODIES = {
    "error": "raise RuntimeError('no GPU here')",
    "missing": "import a_package_that_nobody_has",
    "nothing": "",
    "exit": "raise NotImplementedError",
}


@pytest.fixture(params=BODIES)
def broken(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module of an installed package that cannot be imported, or has not what it offers."""
    name = f"broken_{request.param}"
    (tmp_path / f"{name}.py").write_text(BODIES[request.param])
    monkeypatch.syspath_prepend(str(tmp_path))
    return name


def offering(module: str, group: str) -> object:
    def entry_points(**which: str) -> EntryPoints:
        return EntryPoints([EntryPoint("broken", module, group)]).select(**which)

    return entry_points


def test_a_broken_format_is_named_once_and_rigs_are_read(
    broken: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_rig(ring_rig(2), tmp_path / "rig.json", "colmap")  # the own format asks no other
    monkeypatch.setattr(extensions, "entry_points", offering(f"{broken}:Thing", "sphericalvision.formats"))
    monkeypatch.setattr(formats.FORMATS, "_broken", set())
    with pytest.warns(UserWarning, match=rf"{broken}:Thing.*goes on without"):
        rig = read_rig(tmp_path / "rig.json")
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # it is said once
        assert rig.names == read_rig(tmp_path / "rig.json").names == ["cam1", "cam2"]
    with pytest.raises(ArgumentError, match="repair or uninstall it"):
        formats.FORMATS.find("broken")
    assert formats.FORMATS.find("native") is not None


def test_broken_configs_are_left_out(broken: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running, "entry_points", offering(broken, "sphericalvision.conf"))
    if broken == "broken_nothing":  # a package of configs is empty
        assert running.conf_packages.__wrapped__() == (broken,)
        return
    with pytest.warns(UserWarning, match=broken):
        assert running.conf_packages.__wrapped__() == ()


def test_blocks_of_many_threads_leave_nothing_open() -> None:
    def work() -> None:
        for _ in range(3000):
            with kernels("plain"), kernels("reference"):
                kernel_mode()

    threads = [threading.Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert kernels_module._open_blocks == []
    with kernels("auto"):
        with kernels("plain"), kernels("auto"):
            pass
        assert kernel_mode() == "auto"
        with kernels("plain"):
            inner = kernels("auto")
            with inner:
                pass
            assert kernel_mode() == "plain"  # the equal block outside is another one


@pytest.fixture
def compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The path of a compiler, to be written, and a cache of its own."""
    path = tmp_path / "cxx"
    path.touch(mode=stat.S_IRWXU)
    monkeypatch.setenv("CXX", str(path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name, value in (("loaded", False), ("given_up", False), ("first_asked", None), ("compiling", None)):
        monkeypatch.setattr(build._State, name, value)
    build._compiler.cache_clear()
    yield path
    build._compiler.cache_clear()


def test_a_banner_in_latin_1_is_read(compiler: Path) -> None:
    compiler.write_text(
        '#!/bin/sh\n[ "$1" = --version ] && printf "nicht f\\374r\\n" && exit 0\necho "error: \\344" >&2\nexit 1\n'
    )
    assert build._compiler()[1].startswith("nicht f")
    with pytest.raises(MissingCompilerError, match="could not be built"):
        build.operators_ready("require")


@pytest.mark.parametrize("body", ["sleep 100", '[ "$1" = --version ] && echo x && exit 0\nexec sleep 100'])
def test_a_compiler_that_hangs_is_left_alone(
    compiler: Path, body: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler.write_text(f"#!/bin/sh\n{body}\n")
    monkeypatch.setattr(build, "BANNER", 0.5)
    monkeypatch.setattr(build, "COMPILING", 1.0)
    start = time.monotonic()
    with pytest.raises(MissingCompilerError):
        build.operators_ready("require")
    assert time.monotonic() - start < 30
    assert all(process.wait(10) is not None for process in build._State.processes)


def test_a_child_does_not_wait_for_the_thread_of_its_parent(
    compiler: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler.write_text('#!/bin/sh\n[ "$1" = --version ] && echo x && exit 0\nsleep 1.5\nexit 1\n')
    monkeypatch.setattr(build, "PATIENCE", 0.0)
    build.operators_ready("auto")
    build.operators_ready("auto")
    assert build._State.compiling is not None
    while not build._State.processes and build._State.compiling.is_alive():
        time.sleep(0.1)  # until it waits for the compiler
    time.sleep(0.2)
    child = os.fork()
    if not child:
        signal.alarm(60)
        code = 1
        try:
            build.operators_ready("require")
        except MissingCompilerError:
            code = 0
        finally:
            os._exit(code)
    assert os.waitpid(child, 0)[1] == 0
    build._State.compiling.join()
