# SPDX-License-Identifier: Apache-2.0
"""Times of images in a table next to them: EuRoC's ``data.csv``, KITTI's ``timestamps.txt``, or a recorder's own."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from sphericalvision.capture.sources.moments import Clock
from sphericalvision.core import ArgumentError
from sphericalvision.io.files import read_text
from sphericalvision.io.times import are_counts, seconds, unit_in

_TABLE = re.compile(r"(?i)(data|rgb|meta_?data|frames|.*(time|stamp).*)\.\w+")
"""Names of such tables of any camera."""
_TEXTS, _UNREAD = (".csv", ".txt"), (".npy", ".json")


def listed_clock(
    folders: Mapping[str, Path], labels: Mapping[str, str], names: Mapping[str, Mapping[str, str]]
) -> Clock | None:
    """The times in tables next to images or above their folders; None if no camera has one.

    A line has a time, and in other columns the image's file or number, and the camera if a table has several; or a time
    in a column of each camera; or it is the time of the image of its number, counted from 0 or 1 for all cameras,
    whichever gives more images a time. A header may tell the unit of times.

    Args:
        folders: of each camera's images.
        labels: of the cameras.
        names: camera -> file or number of an image, as a table may call it -> its name.

    Raises:
        ArgumentError: two tables tell different times.
    """
    clocks = filter(None, (_clock(folders, labels, names, first) for first in (0, 1)))
    count = lambda clock: sum(time is not None for own in clock.times.values() for time in own.values())  # noqa: E731
    return max(clocks, key=count, default=None)


def _clock(
    folders: Mapping[str, Path], labels: Mapping[str, str], names: Mapping[str, Mapping[str, str]], first: int
) -> Clock | None:
    """``listed_clock`` where ``first`` is the number of the first line that names no image."""
    sources: set[str] = set()
    clock: dict[str, dict[str, float | None]] = {}
    for camera, folder in folders.items():
        clock[camera] = dict.fromkeys(names[camera].values())
        for place in (folder, folder.parent):
            files = sorted(file for file in place.glob("*") if file.suffix in _TEXTS + _UNREAD)
            files = [file for file in files if _is_of(file.name, labels[camera], labels.values())]
            tables = {
                f.name: times
                for f in files
                if (times := _read(f, labels[camera], [*labels.values()], names[camera], first))
            }
            # A table that is called so and tells no times is said
            unread = [file.name for file in files if re.search("(?i)time|stamp", file.name)]
            table, *others = [*tables] or unread[:1] or [""]
            if any(tables[other] != tables[table] for other in others):
                raise ArgumentError(
                    f"images: {place / table} and {others[0]} tell different times; move one of them"
                )
            sources |= {table} - {""}
            clock[camera] |= tables.get(table, {})
            if tables:
                break
    return Clock(f"the times in {' and '.join(sorted(sources))} next to them", clock) if sources else None


def _is_of(name: str, label: str, labels: Iterable[str]) -> bool:
    """Whether a file may be a table of times of one camera: it is called as this camera, or as no other."""
    match = re.match(rf"({'|'.join(map(re.escape, labels))})(?![A-Za-z0-9])", name)
    return match[1] == label if match and match[1] else bool(_TABLE.fullmatch(name))


def _read(
    path: Path, label: str, labels: Sequence[str], names: Mapping[str, str], first: int
) -> dict[str, float | None]:
    """Image -> seconds of the table of one camera, or of its part in a table of all; empty if it is something else."""
    rows: list[list[str]] = []
    header: list[str] = []
    for line in read_text(path).splitlines() if path.suffix in _TEXTS else ():
        entries = _entries(line.strip("# \t"))
        if not line.startswith("#") and any(e.isdigit() or seconds([e]) != [None] for e in entries):
            rows.append(entries)
        elif not rows:
            header = entries
    columns = list(zip(*([row for row in rows if label in row] or rows), strict=False))
    if len(header) != len(columns):  # words of one column, or nobody knows of which
        header = [" ".join(header) if len(columns) == 1 else ""] * len(columns)
    owners = [re.search(rf"(?<!\d)({'|'.join(map(re.escape, labels))})(?![A-Za-z0-9])", h) for h in header]
    has_all = {owner[1] for owner in owners if owner} == set(labels)  # a column of each camera
    images = [names.get(str(number)) for number in range(first, first + len(rows))]
    clocks: list[list[float | None]] = []
    is_named = len(columns) == 1
    for column, word, owner in zip(columns, header, owners, strict=True):
        if has_all and owner and owner[1] != label:
            continue
        unit, times = unit_in(word), seconds(column, unit_in(word))
        listed = [names.get(Path(entry).name, names.get(entry.lstrip("0") or "0")) for entry in column]
        if unit is None and len(set(listed) - {None}) > len(column) / 2:  # images, or lines, may be missing
            images, is_named = listed, True
            continue
        has_own = len({*times} - {None}) + times.count(None) * has_all == len(times)
        if has_own and (unit or not are_counts(column)):
            clocks.insert(0 if has_all and owner else len(clocks), times)
    pairs = zip(images, clocks[0], strict=True) if clocks and is_named else ()
    return {image: time for image, time in pairs if image}


def _entries(line: str) -> list[str]:
    """The columns of a line; a date and a time of day are one."""
    delimiter = next((sign for sign in ",;\t" if sign in line), None)
    return [entry.strip() for entry in ([line] if seconds([line]) != [None] else line.split(delimiter))]
