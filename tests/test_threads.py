# SPDX-License-Identifier: Apache-2.0
"""Threads and memory: number by affinity and quotas, short waits, freed memory is kept, and what a user sets counts."""

import ctypes
import os
import sys
from pathlib import Path

import pytest
import torch  # noqa: F401 (which some tests take out of the modules)

from sphericalvision.threads import WAITING, _quotas, available_cores, prepare_threads
from tests.processes import python

PROGRAM = """
import os, sys
for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME", "OMP_NUM_THREADS"):
    os.environ.pop(name, None)
os.environ.update(word.split("=") for word in sys.argv[1:])
from sphericalvision.threads import prepare_threads
prepare_threads()
print(*(os.environ.get(name) for name in ("GOMP_SPINCOUNT", "OMP_NUM_THREADS")))
"""

MEMORY = """
import os, resource, sys
os.environ.update(word.split("=") for word in sys.argv[1:])
from sphericalvision.threads import prepare_threads
prepare_threads()
faults = []
for time in range(3):
    block = bytearray(b"1") * (3 * 2**24)  # larger than what glibc learns to keep by itself
    del block
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
print(faults[2] - faults[1])
"""


@pytest.mark.parametrize(
    ("files", "groups", "quotas"),
    [
        ({"cpu.max": "150000 100000"}, "0::/", [1.5]),
        ({"a/cpu.max": "50000 100000", "a/b/cpu.max": "max 100000"}, "0::/a/b", [0.5]),
        ({"cpu.max": "100000 100000"}, "0::/of/the/host", [1.0]),
        ({"unified/a/cpu.max": "200000 100000"}, "1:name=systemd:/\n0::/a", [2.0]),
        ({"a,cpu/cpu.cfs_quota_us": "25000", "a,cpu/cpu.cfs_period_us": "50000"}, "4:a,cpu:/x", [0.5]),
        ({"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, "1:cpu:/", []),
        ({"cpu.max": "nonsense"}, "0::/", []),
        ({}, "5:cpuset:/a\n0::/", []),
    ],
)  # fmt: skip
def test_quotas_of_control_groups(
    files: dict[str, str], groups: str, quotas: list[float], tmp_path: Path
) -> None:
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text + "\n")
    assert sorted(set(_quotas(groups, tmp_path))) == quotas


@pytest.mark.parametrize(("quotas", "cores"), [([], 4), ([0.5], 1), ([2.5, 3.0], 3), ([16.0], 4)])
def test_cores_are_those_of_affinity_and_quota(
    quotas: list[float], cores: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(4)), raising=False)
    monkeypatch.setattr("sphericalvision.threads._quotas", lambda *arguments: quotas)
    assert available_cores() == cores


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="another C library than glibc")
def test_freed_memory_is_kept_unless_the_user_says_otherwise() -> None:
    assert int(python("-c", MEMORY)) < 100
    assert int(python("-c", MEMORY, "MALLOC_ARENA_MAX=4")) > 2000


def test_threads_sleep_soon() -> None:
    assert python("-c", PROGRAM).split()[0] == "1000"


@pytest.mark.parametrize("name", WAITING)
def test_what_a_user_sets_counts(name: str) -> None:
    spin = "5000" if name == "GOMP_SPINCOUNT" else "None"
    setting = f"{name}={'PASSIVE' if name == 'OMP_WAIT_POLICY' else '5000'}"
    assert python("-c", PROGRAM, setting, "OMP_NUM_THREADS=3").split() == [spin, "3"]


@pytest.mark.parametrize("number", ["many", "0", "-2", "1.5"])
def test_a_wrong_number_of_threads_is_reported_once(
    number: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delitem(sys.modules, "torch")
    monkeypatch.setenv("OMP_NUM_THREADS", number)
    prepare_threads()
    prepare_threads()
    assert capfd.readouterr().err.count("OMP_NUM_THREADS") == 1
    assert "OMP_NUM_THREADS" not in os.environ


def test_a_quota_is_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "torch")
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setenv("GOMP_SPINCOUNT", "2000")
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(4)), raising=False)
    monkeypatch.setattr("sphericalvision.threads._quotas", lambda *arguments: [0.5])
    prepare_threads()
    assert os.environ["OMP_NUM_THREADS"] == "1"
