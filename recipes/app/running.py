# SPDX-License-Identifier: Apache-2.0
"""From the words of a command line to the function that does the work: help, version, checks, then Hydra."""

from __future__ import annotations

import atexit
import functools
import gc
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import hydra
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig

from sphericalvision import __version__
from sphericalvision.recipes.app.errors import check_overrides, plain_errors, refuse
from sphericalvision.recipes.app.help import print_help
from sphericalvision.recipes.app.misspelt import wrong_word
from sphericalvision.recipes.app.words import ELSEWHERE, CommandLine, quote_paths, read_words

__all__ = ["config_space", "run_command"]

CONF = "pkg://sphericalvision.conf"


def run_command(config_name: str, task: Callable[[DictConfig], Any]) -> None:
    """Do what ``sys.argv`` says: show help or version, refuse what does not fit, or run ``task``."""
    line = read_words(sys.argv[1:])
    if line.has("--version"):
        print(f"sphericalvision {__version__}")
        return
    line = line._replace(overrides=[*search_path_of_plugins(line), *quote_paths(line.overrides)])
    if wrong := wrong_word(line):
        refuse(wrong)
    if line.has("--help", "-h"):
        with config_space(line.config_dir):
            print_help(config_name, line.overrides)
        return
    if not line.has("--hydra-help", "--shell-completion", "-sc", "--experimental-rerun", *ELSEWHERE):
        with config_space(line.config_dir):
            check_overrides(config_name, line)
    sys.argv[1:] = line.arguments
    warnings.formatwarning = _plain_warning
    decorate = hydra.main(version_base="1.3", config_path=CONF, config_name=config_name)
    decorate(after_torch(plain_errors(with_own_files(task, line.config_dir))))()


def with_own_files(task: Callable[[DictConfig], Any], config_dir: str | None) -> Callable[[DictConfig], Any]:
    """Import the Python files beside the user's own configs before ``task``."""
    if config_dir is None:
        return task
    folder = Path(config_dir).absolute()

    @functools.wraps(task)
    def prepared(config: DictConfig) -> Any:
        from sphericalvision.recipes.app.own_files import import_own_files

        import_own_files(folder)
        return task(config)

    return prepared


def after_torch(task: Callable[[DictConfig], Any]) -> Callable[[DictConfig], Any]:
    """Import torch before ``task``, and keep what that makes out of the garbage collector's sight.

    Modules live until the end. To look through their hundreds of thousands of objects again and again, and once more
    at the exit, takes a second of a command that takes five.
    """

    @functools.wraps(task)
    def prepared(config: DictConfig) -> Any:
        if "torch" not in sys.modules:
            gc.disable()
            import torch  # noqa: F401

            gc.freeze()
            gc.enable()
            atexit.register(gc.freeze)
        return task(config)

    return prepared


@contextmanager
def config_space(config_dir: str | None = None) -> Iterator[None]:
    """Let ``hydra.compose`` find the configs of the package and of a folder of one's own."""
    search_path = create_config_search_path(CONF)
    if config_dir is not None:
        search_path.prepend(provider="command-line", path=f"file://{Path(config_dir).absolute()}")
    GlobalHydra.instance().clear()
    Hydra.create_main_hydra2("check", search_path)
    try:
        yield
    finally:
        GlobalHydra.instance().clear()


def search_path_of_plugins(line: CommandLine) -> list[str]:
    """The word that adds configs of installed packages: their entry points ``sphericalvision.conf`` name a package."""
    packages = sorted(f"pkg://{point.value}" for point in entry_points(group="sphericalvision.conf"))
    if not packages or any(word.startswith("hydra.searchpath=") for word in line.overrides):
        return []
    return [f"hydra.searchpath=[{','.join(packages)}]"]


def _plain_warning(message: Any, *args: Any, **kwargs: Any) -> str:
    """A warning as a sentence, without the line of the program that it came from."""
    return f"Warning: {message}\n"
