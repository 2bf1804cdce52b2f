# SPDX-License-Identifier: Apache-2.0
"""From the words of a command line to the function that does the work: help, version, checks, then Hydra."""

from __future__ import annotations

import atexit
import gc
import io
import sys
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from importlib.metadata import entry_points
from importlib.resources import files
from pathlib import Path
from typing import Any, Protocol

import hydra
from hydra import version

# Hydra's own parts, as its public functions do not serve: ``hydra.main`` composes a configuration twice more, 0.2 s of
# every start, and ``compose`` does not take a folder whose configs come before those of the package.
from hydra._internal.callbacks import Callbacks
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.global_hydra import GlobalHydra
from hydra.core.utils import run_job
from hydra.errors import HydraException
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sphericalvision import __version__
from sphericalvision.recipes.app.errors import override_message, plain_errors, refuse, several_processes
from sphericalvision.recipes.app.help import print_help
from sphericalvision.recipes.app.words import first_values, quote_paths, read_words
from sphericalvision.threads import prepare_threads

__all__ = ["config_space", "run_command"]

CONF = "pkg://sphericalvision.conf"


class Task(Protocol):
    """What is run: a ``Command``, which comes before this module, as it can say what is not installed."""

    name: str

    @property
    def keys(self) -> Any:
        """The types of its keys."""

    def work(self, config: DictConfig) -> Any:
        """Do the work."""


def run_command(command: Task, words: list[str]) -> None:
    """Do what the words of a command line say: show help or version, refuse what does not fit, or let it work."""
    config_name = command.name
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names that the terminal has no letters for
    words = [*quote_paths(words), *search_path_of_plugins(config_name, words)]
    if "--version" in words:
        with plain_errors():
            print(f"sphericalvision {__version__}")
        return
    line = read_words(words, refuse)
    if line.config_dir is not None and not Path(line.config_dir).is_dir():
        refuse(f"--config-dir: {line.config_dir} is no folder (looked in {Path.cwd()})")
    warnings.formatwarning = _plain_warning
    work = partial(do_work, command, line.config_dir and Path(line.config_dir).absolute())
    if line.cfg or line.info or line.hydra_help or line.shell_completion or line.config_path:
        sys.argv[1:] = words  # the last: how Lightning starts the further processes of a training
        hydra.main(version_base="1.3", config_path=CONF, config_name=config_name)(work)()
        return
    with plain_errors(), config_space(line.config_dir) as space:
        if line.help:
            print_help(config_name, line.overrides)
            return
        config = checked_config(space, command, line.overrides, line.multirun)
        try_output(config)
        if line.multirun or config.hydra.mode == RunMode.MULTIRUN:
            space.multirun(config_name, work, [*line.overrides, "hydra.mode=MULTIRUN"])
            return
        callbacks = Callbacks(config)
        callbacks.on_run_start(config=config, config_name=config_name)
        context = HydraContext(space.config_loader, callbacks)
        done = run_job(work, config, "hydra.run.dir", None, context)
        callbacks.on_run_end(config=config, config_name=config_name, job_return=done)
        _ = done.return_value  # raises what the work has raised


def checked_config(space: Hydra, command: Task, overrides: list[str], multirun: bool) -> DictConfig:
    """The configuration of a command line, of a multi-run's first run; exits where it does not fit."""
    try:
        words = first_values(overrides) if multirun else overrides
        config = space.compose_config(command.name, words, RunMode.RUN, with_log_configuration=True)
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        refuse(override_message(error, command.name, overrides))
    if wrong := several_processes(config) if multirun else None:
        refuse(wrong)
    import_torch()  # not before: a misspelt key does not wait for it
    from sphericalvision.recipes.app.checks import check_keys

    check_keys(command.keys, config, words)
    return config


def try_output(config: DictConfig) -> None:
    """Make the folder ``output`` and write a little into it: a full disk takes folders, and Hydra's empty files."""
    if OmegaConf.is_interpolation(config, "output") or config.output is None:
        return
    output = Path(config.output)
    if config.hydra.run.dir == ".":
        if output.is_dir():
            refuse(f"output: {output} is a folder, a file is expected")
        return
    try:
        output.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=output) as probe:
            probe.write(b"there is room")
            probe.flush()
    except OSError as error:
        refuse(
            f"output: {output} is no folder to write to ({error.strerror}); free the disk, or choose another place"
        )


def import_torch() -> None:
    """Import torch, and keep what that makes out of the garbage collector's sight: modules live until the end.

    To look through their hundreds of thousands of objects again and again, and once more at the exit, takes a second of
    a command that takes five.
    """
    prepare_threads()
    if "torch" not in sys.modules:
        gc.disable()
        import torch  # noqa: F401

        gc.freeze()
        gc.enable()
        atexit.register(gc.freeze)


def do_work(command: Task, own_files: Path | None, config: DictConfig) -> Any:
    """Import the Python files next to the user's own configs, let the command work, and tell mistakes plainly."""
    with plain_errors():
        import_torch()
        if own_files is not None:
            from sphericalvision.recipes.app.own_files import import_own_files

            import_own_files(own_files)
        return command.work(config)


@contextmanager
def config_space(config_dir: str | None = None) -> Iterator[Hydra]:
    """Let Hydra find the configs of the package and of a folder of one's own."""
    version.setbase("1.3")
    search_path = create_config_search_path(CONF)
    if config_dir is not None:
        search_path.prepend(provider="command-line", path=f"file://{Path(config_dir).absolute()}")
    outer = GlobalHydra.instance().hydra  # of a command that runs this one
    GlobalHydra.instance().clear()
    try:
        yield Hydra.create_main_hydra2("sphericalvision", search_path)
    finally:
        GlobalHydra.instance().hydra = outer


def search_path_of_plugins(config_name: str, words: list[str]) -> list[str]:
    """The word that adds configs of installed packages: their entry points ``sphericalvision.conf`` name a package.

    It takes the place of the search path in the command's own file, so that has a part in it.
    """
    packages = []
    for point in sorted(entry_points(group="sphericalvision.conf")):
        try:
            import_module(point.value)
        except Exception as error:  # whatever a module of somebody else does when it is imported
            warnings.warn(
                f"{point.value}: configs of an installed package, which cannot be imported "
                f"({type(error).__name__}: {error}); all else goes on without them",
                stacklevel=2,
            )
        else:
            packages.append(f"pkg://{point.value}")
    if not packages or any(word.startswith("hydra.searchpath=") for word in words):
        return []
    text = (files("sphericalvision.conf") / f"{config_name}.yaml").read_text()
    own = OmegaConf.select(OmegaConf.create(text), "hydra.searchpath") or []
    return [f"hydra.searchpath=[{','.join([*own, *packages])}]"]


def _plain_warning(message: Any, *args: Any, **kwargs: Any) -> str:
    """A warning as a sentence, without the line of the program that it came from."""
    return f"Warning: {message}\n"
