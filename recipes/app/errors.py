# SPDX-License-Identifier: Apache-2.0
"""Mistakes on the command line, told in one paragraph: what is wrong, and what to write instead."""

from __future__ import annotations

import difflib
import functools
import os
import re
import sys
from collections.abc import Callable
from typing import Any

from hydra import compose
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from sphericalvision.recipes.app.help import keys_of
from sphericalvision.recipes.app.keys import GROUPS, KEYS
from sphericalvision.recipes.app.misspelt import wrong_place
from sphericalvision.recipes.app.schema import check_config
from sphericalvision.recipes.app.words import CommandLine

__all__ = ["check_keys", "check_overrides", "plain_errors", "refuse"]


PLUGINS = {"hydra/sweeper": "optuna", "hydra/launcher": "launchers"}
"""Groups of Hydra's own whose options are packages, and the extra that brings those of ours."""


def plain_errors(task: Callable[[DictConfig], Any]) -> Callable[[DictConfig], Any]:
    """Print errors that a user can mend without their traceback and exit with status 1.

    Other errors are faults of the program and pass; with ``HYDRA_FULL_ERROR=1`` all do.
    """

    @functools.wraps(task)
    def guarded(config: DictConfig) -> Any:
        try:
            return task(config)
        except KeyboardInterrupt:
            print("\nInterrupted.", file=sys.stderr)
            raise SystemExit(130) from None
        except Exception as error:
            message = _user_message(error)
            if message is None or os.environ.get("HYDRA_FULL_ERROR") == "1":
                raise
            refuse(message)

    return guarded


def check_overrides(config_name: str, line: CommandLine) -> None:
    """Exit with status 1 and one paragraph if the words of a command line do not fit the config ``config_name``."""
    try:
        words = _first_values(line.overrides) if line.multirun else line.overrides
        config = compose(config_name, words, return_hydra_config=True)
        check_keys(config_name, config)
        if line.multirun and (wrong := several_processes(config)):
            refuse(wrong)
        if not line.flags and (wrong := wrong_place(config)):
            refuse(wrong)
    except (HydraException, OmegaConfBaseException) as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        refuse(_override_message(error, config_name, line))
    except ValueError as error:  # a key of another type
        if "Got NoneType" in str(error) and (left := [w for w in line.overrides if w.endswith("=null")]):
            refuse(
                f"{left[0]}: this group cannot be left out; {_program(config_name)} --help lists its options"
            )
        refuse(str(error))


def several_processes(config: DictConfig) -> str | None:
    """What is wrong with a multi-run of trainings in several processes; None if each run is one process."""
    trainer = config.get("trainer") or {}
    devices, nodes, strategy = (trainer.get(key) for key in ("devices", "num_nodes", "strategy"))
    several = (isinstance(devices, int) and devices > 1) or len(re.findall(r"\d+", str(devices))) > 1
    for key, value, wrong in (
        ("devices", devices, several),
        ("num_nodes", nodes, isinstance(nodes, int) and nodes > 1),
        ("strategy", strategy, "ddp" in str(strategy)),
    ):
        if wrong:
            return (
                f"trainer.{key}={value}: the processes of one training and the runs of --multirun do not mix; start a "
                "command for each value, without --multirun"
            )
    return None


def check_keys(config_name: str, config: DictConfig) -> None:
    """Compare the keys of a command, and those that all options of a group have, with their types.

    Raises:
        ArgumentError: the first key that does not fit.
    """
    if config_name in KEYS:
        check_config(config, KEYS[config_name])
    for group, schema in GROUPS.items():
        if group in config:
            check_config(config[group], schema, f"{group}.")


def _first_values(overrides: list[str]) -> list[str]:
    """A multi-run as its first run."""
    parsed = OverridesParser.create().parse_overrides(overrides)
    return [
        f"{word.partition('=')[0]}={next(override.sweep_string_iterator())}"
        if override.is_sweep_override()
        else word
        for word, override in zip(overrides, parsed, strict=True)
    ]


def refuse(message: str) -> None:
    """Say what is wrong and exit with status 1."""
    print(f"\nError: {message}", file=sys.stderr)
    raise SystemExit(1) from None


def _user_message(error: BaseException) -> str | None:
    """Message of the first error in the chain that is meant for users."""
    from sphericalvision.core import SphericalVisionError

    lightning: Any = sys.modules.get("pytorch_lightning.utilities.exceptions")  # imported by training alone
    mistakes = (SphericalVisionError, *([lightning.MisconfigurationException] if lightning else []))
    link: BaseException | None = error
    while link is not None:
        if isinstance(link, mistakes):
            return _without_traceback(str(link))
        link = link.__cause__ or link.__context__
    if isinstance(error, OmegaConfBaseException):
        key = error.full_key or error.key
        if isinstance(error, MissingMandatoryValue):
            return f"{key}: a value is needed here; give it on the command line as {key}=..."
        return f"{key}: {str(error).splitlines()[0]}"
    if isinstance(error, HydraException):
        return " ".join(str(error).split())
    return _disk_message(error)


def _disk_message(error: BaseException) -> str | None:
    """What the system says of a disk, in this process or in one of a data loader."""
    if not isinstance(error, OSError):
        return None
    if error.strerror:
        where, reason = f"{error.filename}: " if error.filename else "", error.strerror
    elif "Original Traceback" in str(error):
        where, reason = "", re.sub(r"^\[Errno \d+\] ", "", _without_traceback(str(error)))
    else:
        return None
    return f"{where}{reason}; free the disk, or choose another place, output=... for results"


def _without_traceback(text: str) -> str:
    """The message alone of an error that came from a process of a data loader, which wraps it in a traceback."""
    if "Original Traceback" not in text:
        return text
    return re.split(r"\n[\w.]+(?:Error|Exception): ", text)[-1].strip()


def _override_message(error: Exception, config_name: str, line: CommandLine) -> str:
    text = str(error)
    unknown = re.search(r"Could not override '([^']+)'", text)
    if unknown:
        key = unknown[1].partition("@")[0]
        if key == "rig" and config_name in ("predict", "inspect"):
            (word,) = [word for word in line.overrides if word.startswith("rig=")][:1] or ["rig=..."]
            return f"{word}: the file is calibration={word[4:]}"
        known = keys_of(compose(config_name))
        near = difflib.get_close_matches(key, known, 3) or [
            name for name in known if name.split(".")[-1] == key.split(".")[-1]
        ]
        hint = f"did you mean {' or '.join(near[:3])}? " if near else ""
        return f"{key}: there is no such key in this configuration; {hint}All keys: {_program(config_name)} --help"
    if missing := re.search(r"Could not find '([^']+)'", text):
        group, _, option = missing[1].rpartition("/")
        options = re.findall(r"^\t(\S+)$", text.partition("Available options")[2], re.MULTILINE)
        if group.startswith("rig") and "file" in options:
            known = ", ".join(options)
            return f"{group}={option}: there is no such rig; known are {known}; for a file: rig=file rig.path=..."
        if group in PLUGINS:
            known = ", ".join(options)
            return (
                f"{group}={option}: there is no such option, or its plugin is not installed (pip install "
                f"'sphericalvision[{PLUGINS[group]}]'); known are {known}"
            )
        return f"{group}={option}: there is no such option; known are {', '.join(options)}"
    return " ".join(text.partition("See https://hydra.cc")[0].split())


def _program(config_name: str) -> str:
    if config_name in ("demo", "digits_table"):
        return f"python -m sphericalvision.recipes.{config_name}"
    return f"sphericalvision-{config_name}"
