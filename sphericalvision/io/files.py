# SPDX-License-Identifier: Apache-2.0
"""Files that appear whole or not at all, whatever is written and however it ends."""

from __future__ import annotations

import errno
import os
import platform
import re
import stat
import time
import uuid
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from sphericalvision.core import ArgumentError, FileFormatError, MissingFileError


def _machine() -> str:
    """This machine and, on Linux, its numbering of processes: containers may share a folder and a name of the host."""
    numbering = ""
    with suppress(OSError):
        numbering = os.readlink("/proc/self/ns/pid")
    return f"{zlib.crc32(f'{platform.node()}{numbering}'.encode()):08x}"


MACHINE = _machine()
LEFT = 7 * 24 * 3600
"""Seconds after which a temporary file of another machine is one that a killed process has left."""
TEMPORARY = re.compile(r"\.([0-9a-f]{8})-(\d+)-[0-9a-f]{32}(\.|$)")
"""Name of a temporary file: machine, process and a unique number."""


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Give a temporary file in the folder of ``path``; it takes the place of ``path`` once the block ends well.

    Whoever reads ``path`` finds the old file or the new one, never half of one; an interrupted or failed block leaves
    the old file and nothing else, and what a killed process has left is removed by the next one that writes there. The
    temporary file has the suffix of ``path``, by which many writers choose their format, and the permissions that the
    process gives to any new file, even if a writer creates it again with fewer.

    Args:
        path: what is to be written; missing folders are made.

    Raises:
        ArgumentError: ``path`` is a folder.
        OSError: if the folder cannot be made or the file not be moved into place.

    Examples:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> with atomic_write(folder / "note.txt") as temporary:
        ...     _ = temporary.write_text("done")
        >>> [file.name for file in folder.iterdir()]
        ['note.txt']
    """
    path = Path(path)
    refuse_folder(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    _sweep(path.parent)
    temporary = path.with_name(f".{MACHINE}-{os.getpid()}-{uuid.uuid4().hex}{path.suffix}")
    try:
        with temporary.open("xb") as created:
            mode = stat.S_IMODE(os.fstat(created.fileno()).st_mode)  # what the umask leaves
        yield temporary
        temporary.chmod(mode)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def refuse_folder(path: Path) -> None:
    """Raise ``ArgumentError`` if a file is to be written where a folder is; to be asked before others are written."""
    if path.is_dir():
        raise ArgumentError(f"path: {path} is a folder; name a file in it")


@cache
def _sweep(folder: Path) -> None:
    """Remove, once for a folder, temporary files of processes of this machine that are no more, and old ones of any."""
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            made_by = TEMPORARY.match(entry.name)
            if not made_by:
                continue
            is_own_machine = made_by[1] == MACHINE
            if not _lives(int(made_by[2])) if is_own_machine else time.time() - entry.stat().st_mtime > LEFT:
                Path(entry.path).unlink(missing_ok=True)


def _lives(process: int) -> bool:
    if os.name == "posix":  # where signal 0 asks, and does nothing
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return False
        except OSError:  # of another user
            return True
    return True


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file whole or not at all.

    Raises:
        OSError: if it cannot be written, also where a full disk takes a part of it without a complaint.
    """
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)
        written = temporary.stat().st_size
        if written != len(content):
            raise OSError(errno.ENOSPC, f"{written} of {len(content)} bytes were written", str(path))


MAX_BYTES = 2**32
"""Of a file that is read as a whole; a sparse file of a few kilobytes may claim to have more than any machine."""


def read_bytes(path: Path, most: int = MAX_BYTES) -> bytes:
    """The content of a file.

    Raises:
        FileFormatError: it has more than ``most`` bytes, or is a pipe or a device, which may never end.
    """
    about = path.stat()
    if not stat.S_ISREG(about.st_mode):
        raise FileFormatError(f"{path}: expected a file, got a folder, a pipe or a device")
    if (size := about.st_size) > most:
        raise FileFormatError(
            f"{path}: has {size:,} bytes, at most {most:,} are read; is it the file you mean?"
        )
    return path.read_bytes()


def read_text(path: Path) -> str:
    """The text of a file, in UTF-8, or in UTF-16 if it begins with a byte order mark, as Windows' shells write it.

    Raises:
        FileFormatError: it is binary, or text in another encoding; the message names it.
    """
    data = read_bytes(path, MAX_BYTES // 4)
    is_marked = data[:2] in (b"\xff\xfe", b"\xfe\xff")
    bad = None
    try:
        text = data.decode("utf-16" if is_marked else "utf-8-sig")
    except UnicodeDecodeError as error:
        text, bad = "", error.start
    if re.search("[\0-\x08\x0e-\x1f]", text or ("" if is_marked else data.decode("latin-1"))):
        zeros = [data[start::2].count(b"\0") for start in (0, 1)]  # of numbers they stand anywhere
        is_wide = not min(zeros) and max(zeros) > 0.4 * len(data)
        kind = "UTF-16 without a byte order mark; save it as UTF-8" if is_wide else "binary data"
        raise FileFormatError(f"{path}: expected a text file, got {kind}")
    if bad is not None:
        raise FileFormatError(
            f"{path}, line {data[:bad].count(bytes([10])) + 1}: expected text in UTF-8, got the byte "
            f"0x{data[bad]:02x}, as in cp1252 or Latin-1 of Windows; save the file as UTF-8"
        )
    return text.replace("\r\n", "\n").replace("\r", "\n")


PORTABLE = r"[^\w.-]"
"""Characters that a name loses: COLMAP's files list names with spaces between them."""
SEPARATORS = r"[/\\\x00-\x1f\ud800-\udfff]"
"""Characters that a name loses if it is to stay as people wrote it."""


def part_of_name(name: str, replaced: str = PORTABLE) -> str:
    """Return a name that comes out of data as a part of a file's name, which leads to no other folder.

    Names that are changed or longer than 80 characters get a number of their own.

    Args:
        name: of a camera, a frame, a view.
        replaced: regular expression of the characters that become ``_``: ``PORTABLE`` or ``SEPARATORS``.

    Examples:
        >>> part_of_name("cam1"), part_of_name("../../x"), part_of_name("left eye", SEPARATORS)
        ('cam1', '.._.._x-422533a8', 'left eye')
    """
    plain = re.sub(r"^\.*$", "_", re.sub(replaced, "_", name)[:80])  # . and .. are folders
    return plain if plain == name else f"{plain}-{zlib.crc32(name.encode(errors='replace')):08x}"


def by_numbers(name: str | Path) -> tuple[list[tuple[int, str]], str]:
    """What names of files are sorted by, so that their numbers count as numbers.

    Examples:
        >>> sorted(["img10.png", "img2.png"], key=by_numbers)
        ['img2.png', 'img10.png']
    """
    key = [(-1, part) for part in re.split(r"(\d+)", str(name))]
    for at in range(1, len(key), 2):  # an odd place holds digits, perhaps more than int() takes
        digits = key[at][1].lstrip("0")
        key[at] = len(digits), digits
    return key, str(name)


def list_folder(folder: str | Path, what: str) -> set[str]:
    """Names of the files in a folder, from one directory scan.

    Raises:
        MissingFileError: there is no such folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise MissingFileError(f"{folder}: no such folder ({what} expected)")
    with os.scandir(folder) as entries:
        return {entry.name for entry in entries if not entry.name.startswith(".")}
