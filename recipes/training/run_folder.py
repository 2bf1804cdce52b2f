# SPDX-License-Identifier: Apache-2.0
"""The folder of a training, kept for one process at a time."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from pytorch_lightning.utilities import rank_zero_only

from sphericalvision.core import ArgumentError

try:
    import fcntl
except ImportError:  # Windows; two trainings in one folder are not noticed there
    fcntl = None  # type: ignore[assignment]

__all__ = ["is_first_process", "run_folder"]

LOCK = ".lock"
"""Held while a training runs; the system lets go of it however the training ends."""


def is_first_process() -> bool:
    """Whether this is the process of rank 0, by the variables that those who start several set."""
    return getattr(rank_zero_only, "rank", 0) == 0


@contextmanager
def run_folder(folder: Path) -> Iterator[None]:
    """Keep a folder for one training.

    Raises:
        ArgumentError: another training is at work in it.
    """
    if not is_first_process() or fcntl is None:  # the first process of a training in several holds it for all
        yield
        return
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ArgumentError(
                f"output: another training is at work in {folder} ({_holder(file)}); wait for its end, or choose "
                "another output=..."
            ) from None
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}")
        file.flush()
        yield


def _holder(file: IO[str]) -> str:
    file.seek(0)
    return file.read(200) or "unknown process"
