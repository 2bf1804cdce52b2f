# SPDX-License-Identifier: Apache-2.0
"""Calibration files of a few hundred bytes that stand for gigabytes are refused in no time, in a short message."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest

from sphericalvision.cameras import read_rig
from sphericalvision.core import FileFormatError, short_repr

LEVELS = "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 9))
BOMB = f"a0: &a0 [lol, lol]\n{LEVELS}"
"""Its last list holds two hundred million words."""
MERGES = "".join(f"a{k}: &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 10)}], k{k}: 1}}\n" for k in range(1, 9))

FILES = {
    "version": f"format: sphericalvision-rig\n{BOMB}version: *a8\ncameras: []\n",
    "model": f"{BOMB}format: sphericalvision-rig\nversion: 1\ncameras: [{{name: a, model: *a8}}]\n",
    "numbers": f"{BOMB}cam0:\n  camera_model: pinhole\n  distortion_model: none\n  intrinsics: *a8\n"
    "  distortion_coeffs: []\n  resolution: [4, 4]\n",
    "kind": f"{BOMB}cam0:\n  camera_model: *a8\n  intrinsics: [1, 1, 1, 1]\n  resolution: [4, 4]\n",
    "merges": f"format: sphericalvision-rig\na0: &a0 {{x: 1}}\n{MERGES}version: 1\ncameras: []\n",
}


@pytest.mark.parametrize("name", FILES)
def test_aliases_do_not_fill_the_memory(name: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(FILES[name])
    assert path.stat().st_size < 1500
    tracemalloc.start()
    with pytest.raises(FileFormatError) as caught:
        read_rig(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(str(caught.value)) < 600 + len(str(path))
    assert peak < 2**25


def test_short_texts_of_values_are_bounded() -> None:
    values: list[object] = ["lol"]
    for _ in range(30):
        values = [values] * 10
    for value in (values, {"a": values, "b": {1: values}}, "x" * 10**6, 10**5000, {k: k for k in range(999)}):
        assert 0 < len(short_repr(value)) <= 200
    assert short_repr([1, "two", None]) == "[1, 'two', None]"
