# SPDX-License-Identifier: Apache-2.0
"""The words of a command line: flags apart, file names taken literally, names that are no more."""

from __future__ import annotations

import os
import re
from typing import NamedTuple

__all__ = ["ELSEWHERE", "CommandLine", "quote_paths", "read_words", "unquote_paths"]

PATH_KEYS = {
    "calibration",
    "capture",
    "images",
    "masks",
    "checkpoint",
    "output",
    "resume",
    "init_weights",
    "root",
    "omnithings",
    "cache_dir",
    "runs",
    "path",
    "ckpt_path",
}
"""Last parts of the keys whose values are file names: what stands there is a name, never Hydra's grammar.

A test compares them with the comments of the YAML files.
"""


ELSEWHERE = ("--config-path", "-cp", "--config-name", "-cn")
"""Flags that take the whole configuration from another place, as the processes of one training do."""


VALUED = ("--cfg", "-c", "--package", "-p", "--info", "-i", "--experimental-rerun", *ELSEWHERE)
"""Flags that a value follows."""


class CommandLine(NamedTuple):
    """A command line taken apart.

    Attributes:
        overrides: words ``key=value``.
        config_dir: folder of one's own configs (``--config-dir``).
        multirun: whether keys may have several values (``--multirun``).
        flags: all other flags, Hydra's business.
    """

    overrides: list[str]
    config_dir: str | None
    multirun: bool
    flags: list[str]

    @property
    def arguments(self) -> list[str]:
        """The command line put together again."""
        folder = [] if self.config_dir is None else ["--config-dir", self.config_dir]
        return [*self.overrides, *folder, *(["--multirun"] if self.multirun else []), *self.flags]

    def has(self, *names: str) -> bool:
        """Whether one of these flags is among the others."""
        return any(flag.partition("=")[0] in names for flag in self.flags)


def read_words(arguments: list[str]) -> CommandLine:
    """Take a command line apart.

    Examples:
        >>> read_words(["-m", "seed=0,1", "--config-dir", "mine"])
        CommandLine(overrides=['seed=0,1'], config_dir='mine', multirun=True, flags=[])
        >>> read_words(["--config-dir=mine", "--cfg", "job"]).flags
        ['--cfg', 'job']
    """
    overrides: list[str] = []
    flags: list[str] = []
    config_dir, multirun = None, False
    waiting = iter(arguments)
    for word in waiting:
        name, equals, value = word.partition("=")
        if name in ("--config-dir", "-cd"):
            config_dir = value if equals else next(waiting, None)
        elif word in ("--multirun", "-m"):
            multirun = True
        elif name in VALUED:
            flags.append(word)
            if not equals and (value := next(waiting, "")):
                flags.append(value)
        elif word.startswith("-"):
            flags.append(word)
        else:
            overrides.append(word)
    return CommandLine(overrides, config_dir, multirun, flags)


def quote_paths(arguments: list[str]) -> list[str]:
    """Quote values of path keys, so that braces, commas and equal signs in file names need no second quoting.

    Examples:
        >>> quote_paths(["images=/data/cam{camera}/{frame:05d}.png", "frames=[1,2]"])
        ["images='/data/cam{camera}/{frame:05d}.png'", 'frames=[1,2]']
    """
    return [_quote_path(argument) for argument in arguments]


def unquote_paths(arguments: list[str]) -> list[str]:
    """Take off the quotes that ``quote_paths`` put on, for showing a command line.

    Examples:
        >>> unquote_paths(quote_paths(["output=my run"]))
        ['output=my run']
    """
    return [_unquote_path(argument) for argument in arguments]


def _unquote_path(argument: str) -> str:
    match = re.match(r"^([\w./@]+)='(.*)'$", argument, re.DOTALL)
    if match is None:
        return argument
    return f"{match[1]}=" + re.sub(r"(\\+)('|$)", lambda end: end[1][: len(end[1]) // 2] + end[2], match[2])


def _quote_path(argument: str) -> str:
    match = re.match(r"^([\w./@]+)=(.*)$", argument, re.DOTALL)
    if match is None or match[1].split(".")[-1] not in PATH_KEYS:
        return argument
    value = match[2]
    if value in ("", "null", "auto") or value[0] in "'\"" or "${" in value:
        return argument
    literal = os.path.expanduser(value)
    escaped = re.sub(r"(\\*)('|$)", lambda end: end[1] * 2 + (r"\'" if end[2] else ""), literal)
    return f"{match[1]}='{escaped}'"
