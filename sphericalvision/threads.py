# SPDX-License-Identifier: Apache-2.0
"""Threads and memory of a process: the cores it may use, how soon a thread without work sleeps, what memory is kept.

Imports nothing heavy: the runtime of OpenMP reads its settings when torch is loaded, and never again.
"""

from __future__ import annotations

import ctypes
import math
import os
import re
import sys
from contextlib import suppress
from pathlib import Path

SPIN = "1000"
"""Rounds for which a thread of libgomp looks for work before it sleeps, some ten microseconds; its own choice is
300,000, three milliseconds. A frame has 2,600 short parallel loops: where another process holds a core, each of them
would end with three milliseconds of waiting. On two cores (AVX-512; four images of 1600 x 1600, means of 22 frames),
with 300, 1,000, 3,000 and 10,000 a frame took 0.87, 0.73, 0.71 and 0.68 times as long as by one thread on idle cores,
and 1.26, 1.31, 1.53 and 1.91 times next to two busy processes. Older cores wake more slowly: with 1,000 and 10,000
it was 0.85 and 0.76 times on idle ones (AVX2; four images of 512 x 512), 1.27 and 1.13 times on busy ones."""

WAITING = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")
"""Variables by which a user says how threads wait."""

M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4
"""Settings of glibc's ``mallopt``: bytes from which freed memory goes back; how many blocks have pages of their own."""


def prepare_threads() -> None:
    """Choose the number of torch's threads and how they wait, and keep memory; to be called before torch is imported.

    Threads that wait sleep soon, and there are no more than the process may use: a container with a quota of one core
    gets one thread, on however many cores its machine has. What the variables ``OMP_*``, ``GOMP_*`` and ``KMP_*`` say
    counts instead; an ``OMP_NUM_THREADS`` that is no number is reported and ignored. What is freed stays the process',
    unless ``MALLOC_*`` or ``GLIBC_TUNABLES`` are set: the next frame needs as much.
    """
    _keep_freed_memory()
    if "torch" in sys.modules:
        return
    if not any(os.environ.get(name) for name in WAITING):
        os.environ["GOMP_SPINCOUNT"] = SPIN
    if (number := os.environ.get("OMP_NUM_THREADS", "").strip()) and not re.fullmatch(
        r"0*[1-9]\d{0,4}(\s*,\s*0*[1-9]\d{0,4})*", number
    ):
        print(
            f"Warning: OMP_NUM_THREADS: expected a whole number of 1 or more, got {number!r}; it is ignored",
            file=sys.stderr,
        )
        del os.environ["OMP_NUM_THREADS"]  # or each library that has OpenMP complains of it again
        number = ""
    # Without a quota OpenMP's own choice is right: the cores that the process may run on.
    if not number and "OMP_THREAD_LIMIT" not in os.environ and available_cores() < _scheduled_cores():
        os.environ["OMP_NUM_THREADS"] = str(available_cores())


def _keep_freed_memory() -> None:
    """Let glibc give nothing back: pages that come anew are cleared one by one, a tenth of a frame's time and more."""
    if any(name.startswith("MALLOC_") or name == "GLIBC_TUNABLES" for name in os.environ):
        return
    with suppress(OSError, AttributeError, TypeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_MAX, 0)
        mallopt(M_TRIM_THRESHOLD, 2**31 - 1)


def available_cores() -> int:
    """The number of cores that this process may use: by its affinity, and by the quotas of its control groups.

    Examples:
        >>> 1 <= available_cores() <= os.cpu_count()
        True
    """
    cores = _scheduled_cores()
    with suppress(OSError, ValueError):  # no Linux, or one without control groups
        groups = Path("/proc/self/cgroup").read_text()
        if quotas := list(_quotas(groups, Path("/sys/fs/cgroup"))):
            cores = min(cores, max(1, math.ceil(min(quotas))))  # half a core is one thread
    return cores


def thread_policy() -> str:
    """The settings of threads in words, as of ``sphericalvision-speed``."""
    names = [*WAITING, *(name for name in ("OMP_NUM_THREADS", "OMP_THREAD_LIMIT") if name in os.environ)]
    settings = [f"{name}={os.environ[name]}" for name in names if os.environ.get(name)]
    return f"{available_cores()} cores may be used, {' '.join(settings) or 'OpenMP as it comes'}"


def _scheduled_cores() -> int:
    """Cores that the process may be scheduled on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _quotas(groups: str, root: Path) -> list[float]:
    """Cores by the quota of each control group above a process; none where there is no quota.

    Args:
        groups: text of ``/proc/self/cgroup``, of version 1, 2 or both.
        root: where control groups are mounted.
    """
    quotas = []
    for line in groups.splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers and "cpu" not in controllers.split(","):
            continue
        # Version 2 has no controllers here. In a container the path may be that of the host, and its group the mount.
        for mount in (root / controllers, root / "cpu") if controllers else (root, root / "unified"):
            group = mount / path.lstrip("/")
            for folder in (group, *group.parents):
                with suppress(OSError, ValueError):
                    if controllers:
                        quota, period = (
                            (folder / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period")
                        )
                    else:
                        quota, period = (folder / "cpu.max").read_text().split()
                    if quota != "max" and int(quota) > 0:
                        quotas.append(int(quota) / int(period))
    return quotas
