# SPDX-License-Identifier: Apache-2.0
"""Files of every format, damaged by hypothesis: refused by name, and never with a raw error.

Keys and values are replaced or gone; ``tests/test_generated_files.py`` replaces bytes and words, and cuts files off.
"""

from __future__ import annotations

import copy
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sphericalvision.cameras import read_cameras
from sphericalvision.core import FileFormatError
from tests.cameras.calibration_samples import KEYED, TEXTS, at, dumped, read_everything, sample

JUNK: list[Any] = [
    "words", "", None, [], {}, [[]], float("nan"), float("inf"), -1.0, 0.0, 1e300, True, [1.0], {"a": 1},
    "1e-3", [None], ["x"] * 4, 10**400,
]  # fmt: skip


@contextmanager
def written(text: str | bytes, name: str) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of implausible rigs, where a pose could still be read
        path = Path(folder) / name
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        yield path


def survives(text: str | bytes, name: str) -> None:
    """Read, or refused with an error that names the file."""
    with written(text, name) as path:
        message = str(path)
        try:
            read_everything(path)
        except FileFormatError as error:
            message = str(error)
        assert str(path) in message


CUT = {  # of the last number of a text one digit may be gone
    "lens.txt": TEXTS["lens.txt"][: TEXTS["lens.txt"].rindex("240 320") + 4],
    "calibration.json": TEXTS["calibration.json"].rstrip(),
}


@pytest.mark.parametrize("name", CUT)
@given(data=st.data())
@settings(max_examples=50, deadline=None)
def test_a_part_of_a_file_is_refused(name: str, data: st.DataObject) -> None:
    with (
        written(CUT[name][: data.draw(st.integers(0, len(CUT[name]) - 1))], name) as path,
        pytest.raises(FileFormatError) as caught,
    ):
        read_cameras(path)
    assert str(path) in str(caught.value)


@given(
    text=st.text(max_size=200), name=st.sampled_from(["a.yaml", "a.json", "a.xml", "a.txt", "cameras.txt"])
)
@settings(max_examples=60, deadline=None)
def test_any_text(text: str, name: str) -> None:
    with written(text, name) as path, pytest.raises(FileFormatError) as caught:
        read_cameras(path)
    assert str(path) in str(caught.value)


def places(content: Any, at: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    """Where values stand, by keys and indices."""
    items = content.items() if isinstance(content, dict) else enumerate(content)
    found: list[tuple[str | int, ...]] = []
    for key, value in items:
        found.append((*at, key))
        if isinstance(value, dict | list):
            found += places(value, (*at, key))
    return found


@given(data=st.data())
@settings(max_examples=200, deadline=None)
def test_anything_in_place_of_a_value(data: st.DataObject) -> None:
    """Values replaced, keys deleted, lists made longer or shorter; also two at once."""
    name = data.draw(st.sampled_from(KEYED))
    content: Any = sample(name)
    for _ in range(data.draw(st.integers(1, 2))):
        *way, last = data.draw(st.sampled_from(places(content)))
        inner = at(content, way)
        damage = data.draw(st.sampled_from(["replace", "delete", "repeat"]))
        if damage == "delete":
            del inner[last]
        elif damage == "repeat" and isinstance(inner, list):
            inner.append(inner[last])
        else:
            inner[last] = copy.deepcopy(data.draw(st.sampled_from(JUNK)))
        if not places(content):
            break
    survives(dumped(content, name), name)
