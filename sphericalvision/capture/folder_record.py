# SPDX-License-Identifier: Apache-2.0
"""What a folder of results holds: of what it was made, which frames, and the checksum of each file."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.io.files import write_bytes

__all__ = ["RECORD", "FolderRecord", "checksum"]

RECORD = "frames.jsonl"
"""In a folder of results, a line of JSON for each statement."""


def checksum(path: Path) -> int | None:
    """CRC-32 of a file's content; None where there is no file that can be read."""
    value = 0
    try:
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                value = zlib.crc32(block, value)
    except OSError:
        return None
    return value


class FolderRecord:
    """Which frames each output of a folder has, and in which files.

    A frame counts as done by this record and by the checksums of its files, so that files of another run, or damaged
    ones, are made again. Every line is written once what it states is on the disk.

    Args:
        folder: of the results.
        basis: what results depend on beside settings, such as the rig and the weights.
        go_on: whether what is there counts; otherwise the record begins anew.

    Attributes:
        frames: output -> its frames, in order.
        files: output of all frames -> the name of its file.

    Raises:
        ArgumentError: the folder's results are of another basis.
        FileFormatError: the record is damaged.
    """

    def __init__(self, folder: Path, basis: Mapping[str, str | None], go_on: bool) -> None:
        self.folder, self.path = folder, folder / RECORD
        self.frames: dict[str, dict[str, None]] = {}
        self.files: dict[str, str] = {}
        self._checksums: dict[str, int | None] = {}
        self._lines = [json.dumps({"basis": dict(basis)})]
        if go_on and self.path.is_file():
            self._read(dict(basis))
        self._begun = False

    def add(self, outputs: Iterable[str], frames: Sequence[str], paths: Iterable[Path]) -> None:
        """State that outputs of frames are done, in these files."""
        files = {self._name_of(path): checksum(path) for path in paths}
        self._append({"outputs": list(outputs), "frames": list(frames), "files": files})

    def replace(self, output: str, frames: Sequence[str], path: Path) -> None:
        """State all frames of an output that has one file for them."""
        files = {self._name_of(path): checksum(path)}
        self._append({"output": output, "frames": list(frames), "files": files})

    def is_intact(self, name: str) -> bool:
        """Whether a file is as it was written, or was never one of these results."""
        return name not in self._checksums or checksum(self.folder / name) == self._checksums[name]

    def _name_of(self, path: Path) -> str:
        return path.relative_to(self.folder).as_posix()

    def _append(self, statement: dict[str, object]) -> None:
        line = json.dumps(statement)
        self._take(json.loads(line))
        self._lines.append(line)
        if self._begun:
            with self.path.open("a") as file:
                file.write(f"{line}\n")
        else:  # what an earlier run left, or a torn last line of it, goes
            write_bytes(self.path, "".join(f"{text}\n" for text in self._lines).encode())
            self._begun, self._lines = True, []

    def _take(self, statement: dict[str, object]) -> None:
        frames, files = dict.fromkeys(statement["frames"]), dict(statement["files"])  # type: ignore[call-overload]
        self._checksums |= files
        if "output" in statement:
            output = str(statement["output"])
            self.frames[output], self.files[output] = frames, next(iter(files))
        else:
            for output in statement["outputs"]:  # type: ignore[attr-defined]
                self.frames.setdefault(output, {}).update(frames)

    def _read(self, basis: dict[str, str | None]) -> None:
        content = self.path.read_bytes()
        first, *rest = content[: content.rfind(b"\n") + 1].splitlines() or [b""]
        try:
            before = json.loads(first)["basis"]
            different = [key for key in {**basis, **before} if basis.get(key) != before.get(key)]
            for line in rest:
                self._take(json.loads(line))
        except (ValueError, KeyError, TypeError, AttributeError, StopIteration) as error:
            raise FileFormatError(
                f"{self.path}: is damaged ({type(error).__name__}: {error}); delete it, and all frames are made again"
            ) from None
        if different:
            raise ArgumentError(
                f"skip_existing: {self.folder} holds results of another {' and another '.join(different)}: what these "
                "files hold has changed since; give another output=, or leave skip_existing out"
            )
        self._lines += [line.decode() for line in rest]
