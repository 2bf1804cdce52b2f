# SPDX-License-Identifier: Apache-2.0
"""Command lines: parsing, quoting of values that Hydra cannot read, and the command lines of next steps."""

import argparse
import difflib
import json
import os
import re
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

SHORT = {"--help": ("-h",), "--multirun": ("-m",), "--shell-completion": ("-sc",), "--run": ("-r",)}
INFO = ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")
"""Choices of Hydra's ``--info``."""


def read_words(words: list[str], fail: Callable[[str], NoReturn]) -> argparse.Namespace:
    """Parse a command line as Hydra does, with the overrides in ``overrides``.

    Args:
        words: of the command line.
        fail: called with the error in a flag.

    Examples:
        >>> line = read_words(["-m", "seed=0,1", "--config-dir", "mine", "level=3"], exit)
        >>> line.overrides, line.multirun, line.config_dir
        (['seed=0,1', 'level=3'], True, 'mine')
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("overrides", nargs="*")
    for flag in ("--help", "--version", "--multirun", "--resolve", "--shell-completion", "--run"):
        parser.add_argument(flag, *SHORT.get(flag, ()), action="store_true")
    parser.add_argument("--config-dir", "-cd")
    parser.add_argument("--cfg", "-c", choices=("job", "hydra", "all"))
    parser.add_argument("--info", "-i", const="all", nargs="?", choices=INFO)
    parser.add_argument("--package", "-p")
    parser.error = fail  # type: ignore[method-assign,assignment]
    line, unknown = parser.parse_known_intermixed_args(words)
    if unknown:
        flags = [f"--{name.replace('_', '-')}" for name in vars(line)]
        similar = difflib.get_close_matches(unknown[0], flags, 2)
        hint = f" (did you mean {' or '.join(similar)}?)" if similar else ""
        fail(f"unknown option {unknown[0]}{hint}; --help lists them")
    line.overrides = quote_paths(line.overrides)
    return line


def first_values(overrides: list[str]) -> list[str]:
    """Return the overrides of a multirun's first run.

    Examples:
        >>> first_values(["seed=3,4", "level=3"])
        ['seed=3', 'level=3']
    """
    parsed = OverridesParser.create().parse_overrides(overrides)
    return [
        f"{word.partition('=')[0]}={next(override.sweep_string_iterator())}"
        if override.is_sweep_override()
        else word
        for word, override in zip(overrides, parsed, strict=True)
    ]


def quote_paths(words: list[str]) -> list[str]:
    """Quote values that Hydra's grammar cannot read, so that braces and equal signs in file names need no quotes.

    Examples:
        >>> quote_paths(["images=/data/cam{camera}/{frame:05d}.png", "frames=[1,2]"])
        ["images='/data/cam{camera}/{frame:05d}.png'", 'frames=[1,2]']
    """
    parser, quoted = OverridesParser.create(), []
    for text in words:
        if match := re.match(r"^([\w./@]+)=(.+)$", text, re.DOTALL):
            key, value = match[1], os.path.expanduser(match[2])
            try:
                parser.parse_override(f"{key}={value}").value()
            except HydraException:
                # In front of a quote, and at the end, Hydra reads two backslashes as one; elsewhere they stay.
                escaped = re.sub(r"(\\*)('|$)", lambda end: end[1] * 2 + (r"\'" if end[2] else ""), value)
                value = f"'{escaped}'"
            text = f"{key}={value}"
        quoted.append(text)
    return quoted


def unquote_paths(words: list[str]) -> list[str]:
    """Remove the quotes of ``quote_paths``, to print a command line.

    Examples:
        >>> unquote_paths(quote_paths(["output={my}"]))
        ['output={my}']
    """
    plain = []
    for text in words:
        if match := re.match(r"^([\w./@]+)='(.*)'$", text, re.DOTALL):
            value = re.sub(r"(\\+)('|$)", lambda end: end[1][: len(end[1]) // 2] + end[2], match[2])
            text = f"{match[1]}={value}"
        plain.append(text)
    return plain


def resume_command(last: Path, max_steps: int | None = None) -> str:
    """Return the command line that resumes this run in its folder, up to ``max_steps`` if given."""
    keys: dict[str, Any] = {"output": last.parent.parent, "resume": last}
    if max_steps:
        keys = {"trainer.max_steps": max_steps, **keys}
    if HydraConfig.get().mode == RunMode.MULTIRUN:  # as a file of hparams sets it
        keys = {"hydra.mode": "RUN", **keys}
    overrides = [word for word in HydraConfig.get().overrides.task if word.partition("=")[0] not in keys]
    overrides = [*unquote_paths(overrides), *(f"{key}={value}" for key, value in keys.items())]
    return shlex.join(["sphericalvision-train", *own_configs(), *overrides])


def own_configs() -> list[str]:
    """Return the flag ``--config-dir`` of this run, if it has one."""
    sources = HydraConfig.get().runtime.config_sources
    return [word for s in sources if s.provider == "command-line" for word in ("--config-dir", s.path)]


def evaluate_command(best: Path, config: DictConfig, of_training: Sequence[str]) -> str:
    """Return the command line that evaluates the best checkpoint on the test split of the same data."""
    choices = HydraConfig.get().runtime.choices
    groups = [f"data={choices['data']}"] + ([f"rig={choices['rig']}"] if "rig" in config.data else [])
    usual = compose("evaluate", groups)
    values: Any = {group: OmegaConf.to_container(config[group], resolve=True) for group in ("rig", "data")}
    changes = [
        f"{group}.{key}={value if isinstance(value, str) else json.dumps(value, separators=(',', ':'))}"
        for group in ("rig", "data")
        for key, value in values[group].items()
        if key in set(usual[group])  # "in" of a config says no to keys that lack a value
        if key != "rig" and (group == "rig" or key not in of_training)
        if group == "data" or "rig" in config.data
        if OmegaConf.is_missing(usual[group], key) or usual[group][key] != value
    ]
    weights = f"checkpoint={best.with_suffix('.safetensors')}"
    return shlex.join(["sphericalvision-evaluate", *own_configs(), weights, *groups, *changes])
