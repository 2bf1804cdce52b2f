# SPDX-License-Identifier: Apache-2.0
"""Words of a command line that mean nothing, found before Hydra sees them, and places that cannot be written to."""

from __future__ import annotations

import difflib
import os
import tempfile
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from sphericalvision.recipes.app.words import VALUED, CommandLine, unquote_paths

__all__ = ["wrong_place", "wrong_word"]

FLAGS = (
    *("--help", "-h", "--version", "--hydra-help", "--multirun", "-m", "--run", "-r", "--resolve"),
    *("--shell-completion", "-sc", "--config-dir", "-cd"),
    *VALUED,
)
"""What Hydra and the commands know; ``VALUED`` are followed by a value."""

CHOICES = {
    "--cfg": ("job", "hydra", "all"),
    "--info": ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath"),
}
SHORT = {"-c": "--cfg", "-i": "--info"}


def wrong_word(line: CommandLine) -> str | None:
    """What is wrong with the first flag or word that cannot be understood, whatever the configuration is."""
    return _wrong_flag(line) or next(filter(None, map(_wrong_override, line.overrides)), None)


def _wrong_flag(line: CommandLine) -> str | None:
    waiting = iter(line.flags)
    for word in waiting:
        flag, equals, value = word.partition("=")
        if flag not in FLAGS:
            near = difflib.get_close_matches(flag, [name for name in FLAGS if name.startswith("--")], 2)
            hint = f"did you mean {' or '.join(near)}? " if near else ""
            return f"{flag}: there is no such flag; {hint}The flags are told by --help"
        if flag in VALUED:
            value = value if equals else next(waiting, "")
            known = CHOICES.get(SHORT.get(flag, flag))
            if not value and flag not in ("--info", "-i"):
                return f"{flag}: a value is needed behind it" + (f": {', '.join(known)}" if known else "")
            if known and value and value not in known:
                return f"{flag}: expected one of {', '.join(known)}, got {value!r}"
    if line.config_dir is not None and not Path(line.config_dir).is_dir():
        return f"--config-dir: {line.config_dir} is no folder (looked in {Path.cwd()})"
    return None


def _wrong_override(word: str) -> str | None:
    key, equals, _ = word.partition("=")
    if not key.strip("+~"):
        return f"{word!r}: expected KEY=VALUE, such as output=results"
    if not equals and not word.startswith("~"):
        return f"{word}: expected KEY=VALUE, got a word without '='"
    try:
        OverridesParser.create().parse_override(word)
    except HydraException as error:
        (shown,) = unquote_paths([word])
        reason = " ".join(str(error).partition("See https://hydra.cc")[0].split())
        return (
            f"{key}: the value of {shown} cannot be read ({reason}); put what has brackets, braces or commas in "
            "quotes of both kinds, KEY='\"VALUE\"'"
        )
    return None


def wrong_place(config: DictConfig) -> str | None:
    """Why the folder ``output`` cannot be made, or the file ``output`` not be written; makes the folder."""
    if "output" not in config or OmegaConf.is_missing(config, "output") or config.output is None:
        return None
    output, folder = Path(str(config.output)), "hydra" not in config or config.hydra.run.dir != "."
    if not folder and output.is_dir():
        return f"output: {output} is a folder, a file is expected"
    there = output if folder else output.parent
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir():
        return f"output: {there} is a file, so no folder can be there"
    if not os.access(there, os.W_OK):
        return f"output: {there} must not be written to; choose another place"
    if folder and not OmegaConf.is_interpolation(config, "output"):
        try:  # now: Hydra would tell it in its own words
            output.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=output) as probe:
                probe.write(b"a full disk takes folders")
                probe.flush()
        except OSError as error:
            return f"output: {output} cannot be written to ({error.strerror}); free the disk, or choose another place"
    return None
