# SPDX-License-Identifier: Apache-2.0
"""Python in a process of its own."""

import os
import subprocess
import sys
from pathlib import Path

__all__ = ["modules_after", "python"]

FORKS = """
import os, sys
import torch
for program in sys.argv[1:]:
    if not os.fork():
        exec(program)
        print("MODULES", *sys.modules, flush=True)
        os._exit(0)
    assert os.wait()[1] == 0, program
"""


def python(*words: str, folder: Path | None = None, path: Path | None = None) -> str:
    """Run Python with these words, in a folder, with a folder of further packages; gives what it printed.

    Processes that wait for each other end after ten minutes.
    """
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **({"PYTHONPATH": str(path)} if path else {})}
    command = [sys.executable, *words]
    result = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=600, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def modules_after(*programs: str) -> list[set[str]]:
    """Names of the modules that each of these programs ends up with, in a process where only torch was imported.

    Torch, most of what a program waits for, is imported once: the processes are forks of one.
    """
    printed = python("-c", FORKS, *programs).split("MODULES ")[1:]
    return [set(names.split()) for names in printed]
