# SPDX-License-Identifier: Apache-2.0
"""Python in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

__all__ = ["python"]


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
