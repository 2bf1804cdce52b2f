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

from hydra import compose, initialize_config_module
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException
from pytorch_lightning.utilities.exceptions import MisconfigurationException

from sphericalvision.core import SphericalVisionError

__all__ = ["check_overrides", "plain_errors"]


def plain_errors(task: Callable[[DictConfig], None]) -> Callable[[DictConfig], None]:
    """Print errors that a user can mend without their traceback and exit with status 1.

    Other errors are faults of the program and pass; with ``HYDRA_FULL_ERROR=1`` all do.
    """

    @functools.wraps(task)
    def guarded(config: DictConfig) -> None:
        try:
            task(config)
        except KeyboardInterrupt:
            print("\nInterrupted.", file=sys.stderr)
            raise SystemExit(130) from None
        except Exception as error:
            message = _user_message(error)
            if message is None or os.environ.get("HYDRA_FULL_ERROR") == "1":
                raise
            _exit(message)

    return guarded


def check_overrides(config_name: str, arguments: list[str]) -> None:
    """Exit with status 1 and one paragraph if the words of a command line do not fit the config ``config_name``.

    Command lines with flags (``--help``, ``--config-dir``, ``--multirun``) are left to Hydra.
    """
    if any(argument.startswith("-") for argument in arguments):
        return
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        try:
            compose(config_name, arguments)
        except (HydraException, OmegaConfBaseException) as error:
            if os.environ.get("HYDRA_FULL_ERROR") == "1":
                raise
            _exit(_override_message(error, config_name))


def _exit(message: str) -> None:
    print(f"\nError: {message}", file=sys.stderr)
    raise SystemExit(1) from None


def _user_message(error: BaseException) -> str | None:
    """Message of the first error in the chain that is meant for users."""
    link: BaseException | None = error
    while link is not None:
        if isinstance(link, (SphericalVisionError, MisconfigurationException)):
            return str(link)
        link = link.__cause__ or link.__context__
    if isinstance(error, OmegaConfBaseException):
        key = error.full_key or error.key
        if isinstance(error, MissingMandatoryValue):
            return f"{key}: a value is needed here; give it on the command line as {key}=..."
        return f"{key}: {str(error).splitlines()[0]}"
    if isinstance(error, HydraException):
        return " ".join(str(error).split())
    return None


def _override_message(error: Exception, config_name: str) -> str:
    text = str(error)
    if unknown := re.search(r"Could not override '([^']+)'", text):
        key = unknown[1]
        known = _keys(compose(config_name))
        near = difflib.get_close_matches(key, known, 3) or [
            name for name in known if name.split(".")[-1] == key.split(".")[-1]
        ]
        hint = f"did you mean {' or '.join(near[:3])}? " if near else ""
        command = f"sphericalvision-{config_name} --help"
        return f"{key}: there is no such key in this configuration; {hint}All keys: {command}"
    if missing := re.search(r"Could not find '([^']+)'", text):
        group, _, option = missing[1].rpartition("/")
        options = re.findall(r"^\t(\S+)$", text.partition("Available options")[2], re.MULTILINE)
        return f"{group}={option}: there is no such option; known are {', '.join(options)}"
    return " ".join(text.partition("See https://hydra.cc")[0].split())


def _keys(config: Any, prefix: str = "") -> list[str]:
    """All keys of a config, nested ones with dots; values are not resolved."""
    keys = []
    for key in config:
        keys.append(f"{prefix}{key}")
        node = config._get_node(key)
        if isinstance(node, DictConfig) and not node._is_none() and not node._is_missing():
            if node._is_interpolation():
                continue
            keys += _keys(node, f"{prefix}{key}.")
    return keys
