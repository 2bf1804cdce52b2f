# SPDX-License-Identifier: Apache-2.0
"""Ten thousand damaged files for every reader: none has another error than its own, hangs, or fills the memory.

``SPHERICALVISION_EXAMPLES=200`` makes it a matter of minutes, a million one of days; ``SPHERICALVISION_SEED`` damages
other places. What a reader cost is printed (``pytest -rP``).
"""

import ctypes
import os
import random
import re
import signal
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from sphericalvision.cameras.calibration.formats import file_formats
from sphericalvision.cameras.calibration.text_files import load, looks_structured
from sphericalvision.core import FileFormatError, SphericalVisionError
from tests.readers import READERS, Reader, files

EXAMPLES = int(os.environ.get("SPHERICALVISION_EXAMPLES", "10000"))
SEED = int(os.environ.get("SPHERICALVISION_SEED", "0"))
MOST_MEMORY = 300 * 2**20
MOST_SECONDS = 5  # of the processor, for one file
HANGS = 120  # seconds by the clock, on a machine that does much else
LONGEST = 3000  # characters of a message

TOKENS = [
    b"nan", b"inf", b"-1", b"0", b"1e308", b"-1e308", b"1e400", b"1e-320", b"9" * 30, b"9" * 5000, b"2147483648",
    b"100000", b"10", b"null", b"true", b"\x00", b"\xff\xfe", b"\xff\xff\xff\x7f", b"\xef\xbb\xbf", b"&a [*a]",
    b"*a", b"<<: *a", b"!!python/object/apply:os.system [id]", b"[" * 500, b"{" * 500, b"[" * 3000,
    b"<!DOCTYPE a [<!ENTITY b SYSTEM 'c'>]>", b"&lt;", b"\n", b"\r", b"\t", b" ", b"#", b": ", b"- ", b",", b"]",
    b"}", b"'", b'"', b"../../x", b"/etc/passwd", b"1_000", b"0x10", b"1:30", b"2020-01-01", b"2020-13-45", b"%s",
    "\N{ARABIC-INDIC DIGIT THREE}".encode(), "\N{SUPERSCRIPT TWO}".encode(),
]  # fmt: skip


class Cost(NamedTuple):
    """Of many files."""

    refused: int
    seconds: float
    """Of the processor, all files together."""
    slowest: float
    memory: int
    """Bytes more than before, at most."""


def damaged(content: bytes, chance: random.Random) -> bytes:
    """A file with a few of its bytes or words replaced, repeated, moved or gone; perhaps cut off."""
    for _ in range(chance.choice((1, 1, 1, 2, 3, 4))):
        start = chance.randint(0, len(content))
        end = min(len(content), start + chance.randint(0, chance.choice((1, 4, 40))))
        kind = chance.choice(("word", "word", "token", "bytes", "bit", "delete", "repeat", "move"))
        if kind == "word":
            words = list(re.finditer(rb"[-+.\w]+", content))
            if words:
                start, end = chance.choice(words).span()
        if kind in ("word", "token"):
            middle = chance.choice(TOKENS)
        elif kind == "bytes":
            middle = chance.randbytes(chance.randint(1, 8))
        elif kind == "bit" and start < len(content):
            end, middle = start + 1, bytes([content[start] ^ (1 << chance.randrange(8))])
        elif kind == "repeat":
            middle = content[start:end] * chance.randint(2, 50)
        elif kind == "move":
            place = chance.randint(0, len(content))
            middle = content[place : place + 40]
        else:
            middle = b""
        content = content[:start] + middle + content[end:]
    return content[: chance.randint(0, len(content))] if chance.random() < 0.1 else content


class TooLong(BaseException):
    """No reader catches it."""


@contextmanager
def in_time() -> Iterator[None]:
    """Fail instead of hanging."""

    def late(number: int, frame: Any) -> None:
        raise TooLong(f"not read in {HANGS} seconds")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, HANGS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def memory(most: bool = False) -> int:
    """Bytes of this process in memory, now or at most since `forget_peak`."""
    found = re.search(rf"{'VmHWM' if most else 'VmRSS'}:\s+(\d+)", Path("/proc/self/status").read_text())
    return 1024 * int(found[1]) if found else 0


def forget_peak() -> None:
    """Give back what is free, and begin a new peak, where the system can."""
    if Path("/proc/self/clear_refs").exists():
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")


def read_damaged(name: str, count: int, folder: Path) -> Cost:
    """Read so many damaged files by a reader; whatever is not as it must be is raised with the number of the file."""
    reader: Reader = READERS[name]
    for file, content in files(reader.folder).items():
        (folder / file).write_bytes(content)
    path, content = folder / reader.file, files(reader.folder)[reader.file]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of implausible rigs, where a pose could still be read
        reader.read(path)
        forget_peak()
        before, refused, seconds, slowest = memory(), 0, 0.0, 0.0
        for number in range(count):
            path.write_bytes(damaged(content, random.Random(f"{SEED} {name} {number}")))
            began, said, unnamed = time.process_time(), "", False
            try:
                with in_time():
                    reader.read(path)
            except SphericalVisionError as error:
                refused, said = refused + 1, str(error)
                unnamed = isinstance(error, FileFormatError) and str(folder) not in said
            except BaseException as error:
                error.add_note(f"{name}, file {number} with SPHERICALVISION_SEED={SEED}, left in {path}")
                raise
            took = time.process_time() - began
            assert not unnamed, (number, said)
            assert len(said) < LONGEST, (number, said[:LONGEST])
            seconds, slowest = seconds + took, max(slowest, took)
            assert took < MOST_SECONDS, (number, path)
            assert memory(most=True) - before < MOST_MEMORY, (number, path)
    return Cost(refused, seconds, slowest, max(memory(most=True) - before, 0))


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_every_damaged_file_is_read_or_refused(name: str, tmp_path: Path) -> None:
    if name.startswith("mesh"):
        pytest.importorskip("embreex")
    cost = read_damaged(name, EXAMPLES, tmp_path)
    print(
        f"{name}: {EXAMPLES} files, {cost.refused} refused, {cost.seconds:.0f} s of the processor, "
        f"slowest {cost.slowest:.2f} s, {cost.memory / 2**20:.0f} MB"
    )


@pytest.mark.parametrize("name", [name for name in READERS if not name.startswith("mesh")])
def test_a_few_damaged_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    read_damaged(name, 10, tmp_path)


def format_of(path: Path) -> str | None:
    """Name of the format that recognises a file."""
    for format in file_formats():
        if format.recognizes_file and format.read_file and format.recognizes_file(path):
            return format.name
    content = load(path) if looks_structured(path) else None
    for format in file_formats() if isinstance(content, dict) else ():
        if format.recognizes_keys and format.read_keys and format.recognizes_keys(content):
            return format.name
    return None


def test_every_format_is_damaged(tmp_path: Path) -> None:
    """No format of calibrations is registered that these tests do not know."""
    found = set()
    for folder in ("texts", "own", "ocam", "omnimvs", "vins", "bin"):
        (tmp_path / folder).mkdir()
        for name, content in files(folder).items():
            path = tmp_path / folder / name
            path.write_bytes(content)
            if path.suffix != ".png" and path.stem != "points3D":
                found.add(format_of(path))
    assert {format.name for format in file_formats()} <= found
