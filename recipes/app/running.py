# SPDX-License-Identifier: Apache-2.0
"""From the words of a command line to the function that does the work: help, version, checks, then Hydra."""

import atexit
import gc
import io
import os
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import hydra
from hydra import initialize_config_module
from hydra.core.config_loader import ConfigLoader
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.core.utils import configure_log, run_job
from hydra.errors import HydraException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sphericalvision import __version__
from sphericalvision.recipes.app.errors import (
    FAILURE,
    override_message,
    plain_errors,
    refuse,
    several_processes,
)
from sphericalvision.recipes.app.help import print_help
from sphericalvision.recipes.app.words import first_values, quote_paths, read_words
from sphericalvision.threads import prepare_threads

CONF = "sphericalvision.conf"


def run_command(command: Any, words: list[str]) -> None:
    """Do what the words of a command line say: show help or version, refuse what does not fit, or let it work."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed by the caller: results are files
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 (open until the process ends)
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names that the terminal has no letters for
    line = read_words(words, refuse)
    if line.version:
        with plain_errors():
            print(f"sphericalvision {__version__}")
        return
    if line.config_dir is not None and not Path(line.config_dir).is_dir():
        refuse(f"--config-dir: {line.config_dir} is no folder (looked in {Path.cwd()})")
    warnings.formatwarning = lambda message, *_, **__: (
        f"Warning: {message}\n"
    )  # without a line of the program
    work = partial(do_work, command, line.config_dir and Path(line.config_dir).absolute())
    if line.cfg or line.info or line.shell_completion:
        Plugins.instance().register(ConfigFolders)
        sys.argv[1:] = quote_paths(words)
        with plain_errors():
            hydra.main(version_base="1.3", config_path=f"pkg://{CONF}", config_name=command.name)(work)()
        return
    with plain_errors(), config_space(line.config_dir) as loader:
        if line.help:
            print_help(command.name, line.overrides)
            return
        config = checked_config(loader, command, line.overrides, line.multirun)
        try_output(config)
        if line.multirun or config.hydra.mode == RunMode.MULTIRUN:
            sweep(loader, command, line.overrides, work)
            return
        callbacks = Callbacks(config)
        callbacks.on_run_start(config=config, config_name=command.name)
        context = HydraContext(loader, callbacks)  # type: ignore[arg-type]
        done = run_job(work, config, "hydra.run.dir", None, context)
        callbacks.on_run_end(config=config, config_name=command.name, job_return=done)
        _ = done.return_value  # raises what the work has raised


def sweep(loader: ConfigLoader, command: Any, overrides: list[str], work: Callable[..., Any]) -> None:
    """Run a command once for each value; exits with status 1 where runs have failed, after all have run."""
    config = loader.load_configuration(command.name, [*overrides, "hydra.mode=MULTIRUN"], RunMode.MULTIRUN)
    callbacks = Callbacks(config)
    context = HydraContext(loader, callbacks)  # type: ignore[arg-type]
    configure_log(config.hydra.hydra_logging, config.hydra.verbose)
    callbacks.on_multirun_start(config=config, config_name=command.name)
    sweeper = Plugins.instance().instantiate_sweeper(hydra_context=context, task_function=work, config=config)
    sweeper.sweep([str(word) for word in config.hydra.overrides.task])
    callbacks.on_multirun_end(config=config, config_name=command.name)
    folder = Path(config.hydra.sweep.dir)
    if failed := sorted(path.parent.name for path in folder.glob(f"*/{FAILURE}")):
        refuse(f"{len(failed)} of the runs failed: {', '.join(failed)} in {folder}, each with {FAILURE}")


class Callbacks:
    """The callbacks that a configuration names, called together."""

    def __init__(self, config: DictConfig) -> None:
        nodes = (config.hydra.callbacks or {}).values()
        self._callbacks = [hydra.utils.instantiate(node) for node in nodes if node is not None]

    def __getattr__(self, event: str) -> Callable[..., None]:
        if not event.startswith("on_"):  # copies ask for other things
            raise AttributeError(event)
        return partial(self._call, event)

    def _call(self, event: str, **arguments: Any) -> None:
        for callback in self._callbacks:
            getattr(callback, event)(**arguments)


def checked_config(loader: ConfigLoader, command: Any, overrides: list[str], multirun: bool) -> DictConfig:
    """The configuration of a command line, of a multi-run's first run; exits where it does not fit."""
    try:
        single = first_values(overrides) if multirun else overrides
        config = loader.load_configuration(command.name, single, RunMode.RUN)
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        refuse(override_message(error, command.name, overrides))
    if wrong := several_processes(config) if multirun else None:
        refuse(wrong)
    if config.hydra.job.chdir:
        refuse(
            "hydra.job.chdir: files are named from the folder you are in; leave it out, output= is for results"
        )
    import_torch()  # not before: a misspelt key does not wait for it
    from sphericalvision.recipes.app.checks import check_keys

    check_keys(command.keys, config, single)
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
            f"output: cannot write to the folder {output} ({error.strerror}); free the disk, or choose another"
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


def do_work(command: Any, own_files: Path | None, config: DictConfig) -> Any:
    """Import the Python files next to the user's own configs, let the command work, and report mistakes plainly.

    A run of a sweep that fails leaves the reason in its folder, and the others go on.
    """
    run = HydraConfig.get()
    closed = "stdout: its reader is gone, and results may be incomplete; redirect the output to a file"
    failure = Path(run.runtime.output_dir, FAILURE) if run.mode == RunMode.MULTIRUN else None
    if failure is not None:
        failure.unlink(missing_ok=True)  # of an earlier sweep
    with plain_errors(closed, failure):
        import_torch()
        if own_files is not None:
            from sphericalvision.recipes.app.own_files import import_own_files

            import_own_files(own_files)
        return command.work(config)
    return None


class ConfigFolders(SearchPathPlugin):
    """Further folders of configs: one of the user's, which comes first, and installed packages.

    Attributes:
        own: the folder of this command line.
    """

    own: Path | None = None

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Add them."""
        if self.own is not None:
            search_path.prepend(provider="command-line", path=f"file://{self.own}")
        for package in conf_packages():
            search_path.append(provider="sphericalvision.conf", path=f"pkg://{package}")


@contextmanager
def config_space(config_dir: str | None = None) -> Iterator[ConfigLoader]:
    """Let Hydra find the configs of the package and of a folder of one's own."""
    Plugins.instance().register(ConfigFolders)
    outer, outer_folder = GlobalHydra.instance().hydra, ConfigFolders.own  # of a command that runs this one
    GlobalHydra.instance().clear()
    ConfigFolders.own = Path(config_dir).absolute() if config_dir is not None else None
    try:
        with initialize_config_module(CONF, version_base="1.3"):
            yield GlobalHydra.instance().config_loader()
    finally:
        GlobalHydra.instance().hydra, ConfigFolders.own = outer, outer_folder


@cache
def conf_packages() -> tuple[str, ...]:
    """Packages with configs: what the entry points ``sphericalvision.conf`` of installed packages name."""
    packages = []
    for point in sorted(entry_points(group="sphericalvision.conf")):
        try:
            import_module(point.value)
        except Exception as error:  # whatever a module of somebody else does when it is imported
            warnings.warn(
                f"{point.value}: the configs of this installed package are not used, as it cannot be imported "
                f"({type(error).__name__}: {error})",
                stacklevel=2,
            )
        else:
            packages.append(point.value)
    return tuple(packages)
