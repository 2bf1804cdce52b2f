# SPDX-License-Identifier: Apache-2.0
"""Errors for users in one paragraph: what is wrong, and what to write instead."""

import difflib
import os
import re
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn

from hydra import compose
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from sphericalvision.recipes.app.help import keys_of, options_of

FAILURE = "failed.txt"
"""File in the folder of a sweep's run: the reason of its failure."""
PLUGINS = {"hydra/sweeper": "optuna", "hydra/launcher": "launchers"}
"""Group of Hydra whose options are packages -> our extra that installs them."""


def refuse(message: str) -> NoReturn:
    """Print what is wrong and exit with status 1."""
    print(f"\nError: {message}", file=sys.stderr)
    raise SystemExit(1) from None


@contextmanager
def plain_errors(on_closed_pipe: str | None = None, failure: Path | None = None) -> Iterator[None]:
    """Print errors that a user can mend without their traceback and exit with status 1.

    Other errors are faults of the program and pass; with ``HYDRA_FULL_ERROR=1`` all do.

    Args:
        on_closed_pipe: printed where the reader of the output is gone, as in "... --help | head -1".
        failure: file for why a run of a sweep failed; the sweep goes on after any error.
    """
    try:
        try:
            yield
        finally:
            _flush()
    except BrokenPipeError:
        if on_closed_pipe is not None:
            print(f"\nError: {on_closed_pipe}", file=sys.stderr)
        raise SystemExit(128 + 13) from None  # as a program that SIGPIPE ends
    except Exception as error:
        message = _message(error)
        is_fault = message is None or os.environ.get("HYDRA_FULL_ERROR") == "1"
        message = message or f"{type(error).__name__}: {error}"
        if failure is None and is_fault:
            raise
        if failure is None:
            refuse(message)
        if is_fault:
            traceback.print_exception(error)
        failure.write_text(message + "\n")
        print(f"\nError: {message}", file=sys.stderr)


def _flush() -> None:
    """Flush the output here, where a closed pipe or a full disk is reported, and not when Python ends."""
    try:
        sys.stdout.flush()
    except OSError:
        with suppress(OSError, ValueError):  # the buffer is still full, and goes nowhere
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise


def override_message(error: Exception, command: str, words: Sequence[str]) -> str:
    """Describe an override among ``words`` that does not fit the configuration of a command, from Hydra's error."""
    text = " ".join(str(error).partition("See https://hydra.cc")[0].split())
    program = "python -m sphericalvision.recipes.demo" if command == "demo" else f"sphericalvision-{command}"
    if isinstance(error, OverrideParseException):
        return f"{error.override}: expected KEY=VALUE, such as output=results ({text})"
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, option = error.missing_cfg_file.rpartition("/")
        hint = f" (a plugin? pip install 'sphericalvision[{PLUGINS[group]}]')" if group in PLUGINS else ""
        options = ", ".join(name for name in error.options or () if not name.startswith("_"))  # as in --help
        if group.partition("/")[0] == "rig":
            hint = "; for a calibration file write rig=file rig.path=..."
        return f"{group}={option}: there is no such option{hint}; known are {options}"
    if match := re.search(r"Could not override '([^'@]+)", text):
        return f"{match[1]}: {_unknown_key(match[1], command, words)} {program} --help lists all keys"
    return f"{text}; {program} --help lists groups with their options, and keys"


def _unknown_key(key: str, command: str, words: Sequence[str]) -> str:
    """Say of a key that is not in a configuration where it is, or which is meant."""
    groups = compose(command, return_hydra_config=True).hydra.runtime.choices
    choices = [word for word in words if word.partition("=")[0] in {*groups} - {key}]
    if match := re.fullmatch(r"(.+?)\.(\d+)\.(.+)", key):
        table, index, name = match.groups()
        return f"names with dots do not reach tables of numbers; write '{table}={{{index}:{{{name}:...}}}}'."
    group, dot, _ = key.partition(".")
    owners = [  # options alone: to compose the command with each would take seconds
        f"{group}={option}"
        for option in (options_of(group, command) if group in groups else ())
        if key in _keys_with(f"{group}/{option}")
    ]
    if owners or key in keys_of(compose(command)):
        return "does not count with the options given; leave it out" + (
            f" (it is a key of {', '.join(owners)})." if owners else "."
        )
    keys = [name for name in _keys_with(command, choices) if "._" not in name]
    similar = difflib.get_close_matches(key, keys, 3) or [
        other for other in keys if other.rpartition(".")[2] == key.rpartition(".")[2]
    ]
    if key == "rig" and "calibration" in keys:  # a group of the commands that render
        similar = ["calibration"]
    hint = f"; did you mean {' or '.join(similar[:3])}?" if similar else "."
    if not similar and dot and (siblings := [k[len(group) + 1 :] for k in keys if k.startswith(f"{group}.")]):
        hint = f"; {group} has {', '.join(siblings)}."
    return f"there is no such key in this configuration{hint}"


def _keys_with(config_name: str, choices: Sequence[str] = ()) -> Sequence[str]:
    """Return the keys of a command, or of an option alone, with options of groups; none where these do not fit."""
    try:
        return list(keys_of(compose(config_name, list(choices))))
    except HydraException:
        return []


def several_processes(config: DictConfig) -> str | None:
    """Describe why a multirun cannot start trainings of several processes; None if each run is one process."""
    trainer = config.get("trainer") or {}
    devices, nodes, strategy = (trainer.get(key) for key in ("devices", "num_nodes", "strategy"))
    # Lightning takes devices as a number, or as indices in a list or a text.
    count = devices if isinstance(devices, int) else len(re.findall(r"\d+", str(devices)))
    for key, value, several in (
        ("devices", devices, count > 1),
        ("num_nodes", nodes, nodes not in (None, 1)),
        ("strategy", strategy, "ddp" in str(strategy)),
    ):
        if several:
            return (
                f"trainer.{key}={value}: --multirun cannot start trainings of several processes; start a command for "
                "each value, without --multirun"
            )
    return None


def _message(error: BaseException) -> str | None:
    """Return the message of the first error in the chain that is meant for users."""
    core, lightning = (
        sys.modules.get(name) for name in ("sphericalvision.core", "pytorch_lightning.utilities.exceptions")
    )
    mistakes: list[Any] = [core.SphericalVisionError] if core else []
    mistakes += [lightning.MisconfigurationException] if lightning else []
    link: BaseException | None = error
    while link is not None:
        if isinstance(link, tuple(mistakes)):
            return _without_traceback(str(link))
        link = link.__cause__ or link.__context__
    if isinstance(error, OmegaConfBaseException):
        key = error.full_key or error.key
        if isinstance(error, MissingMandatoryValue):
            return f"{key}: give a value on the command line, {key}=..."
        return f"{key}: {str(error).splitlines()[0]}"
    if isinstance(error, HydraException):
        return " ".join(str(error).split())
    if isinstance(error, OSError) and (error.strerror or "Original Traceback" in str(error)):
        where = f"{error.filename}: " if error.filename else ""
        reason = error.strerror or re.sub(r"^\[Errno \d+\] ", "", _without_traceback(str(error)))
        return f"{where}{reason}; free the disk, or choose another folder, output=... for results"
    return None


def _without_traceback(text: str) -> str:
    """Return the message of an error from a worker of a data loader, without the traceback around it."""
    if "Original Traceback" not in text:
        return text
    return re.split(r"\n[\w.]+(?:Error|Exception): ", text)[-1].strip()
