# SPDX-License-Identifier: Apache-2.0
"""Calibrations cut off or filled with other things than expected are refused by name, never with a raw error."""

from __future__ import annotations

import copy
import json
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from test_calibration import OCAM, basalt, omnimvs

from sphericalvision.cameras import read_camera, read_rig, ring_rig
from sphericalvision.core import FileFormatError, MissingFileError

LAST_LINE = OCAM.rindex("240 320")


def own_rig() -> dict[str, Any]:
    """A rig as the package writes it."""
    with tempfile.TemporaryDirectory() as folder:
        ring_rig(2).to_yaml(Path(folder) / "rig.yaml")
        return dict(yaml.safe_load((Path(folder) / "rig.yaml").read_text()))


CONTENTS: dict[str, Callable[[], dict[str, Any]]] = {
    "config.yaml": omnimvs,
    "calibration.json": basalt,
    "rig.yaml": own_rig,
}


def refuses(text: str, name: str, read: Callable[[Path], object]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_text(text)
        with pytest.raises(FileFormatError) as caught:
            read(path)
        assert str(path) in str(caught.value)


@given(end=st.integers(0, LAST_LINE + len("240")))
@settings(max_examples=60, deadline=None)
def test_ocam_text_cut_anywhere_is_refused(end: int) -> None:
    refuses(OCAM[:end], "ocam1.txt", read_camera)


@given(end=st.integers(0, len(json.dumps(basalt())) - 1))
@settings(max_examples=30, deadline=None)
def test_json_cut_anywhere_is_refused(end: int) -> None:
    refuses(json.dumps(basalt())[:end], "calibration.json", lambda path: read_rig(path, max_angle=1.0))


def places(content: Any, at: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    """Where a value that readers need stands, by keys and indices."""
    ignored = {"config", "dataset", "img_dir", "invalid_mask", "version", "format", "name", "cam_id"}
    optional = {"inv_poly", "max_fov", "model"}
    items = content.items() if isinstance(content, dict) else enumerate(content)
    found = []
    for key, value in items:
        if key in ignored | optional:
            continue
        found.append((*at, key))
        if isinstance(value, dict | list):
            found += places(value, (*at, key))
    return found


@pytest.mark.parametrize("name", CONTENTS)
@pytest.mark.parametrize("junk", ["words", None, [], {}, float("nan")], ids=repr)
def test_other_things_at_any_place_are_refused(name: str, junk: Any) -> None:
    intact = CONTENTS[name]()
    for place in places(intact):
        content: Any = copy.deepcopy(intact)
        inner = content
        for key in place[:-1]:
            inner = inner[key]
        inner[place[-1]] = junk
        text = json.dumps(content) if name.endswith("json") else yaml.safe_dump(content)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of implausible rigs, where a pose could still be read
            refuses(text, name, lambda path: read_rig(path, max_angle=1.0))


def test_missing_mask_is_named(tmp_path: Path) -> None:
    content = own_rig()
    content["cameras"][0]["mask"] = "front.png"
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(MissingFileError, match=r"front\.png: no such file"):
        read_rig(tmp_path / "rig.yaml")


def test_writing_replaces_a_file_at_once_and_leaves_nothing_else(tmp_path: Path) -> None:
    for radius in (0.1, 0.2):
        ring_rig(3, radius=radius).to_yaml(tmp_path / "rig.yaml")
    assert [path.name for path in tmp_path.iterdir()] == ["rig.yaml"]
    assert read_rig(tmp_path / "rig.yaml").radius.item() == pytest.approx(0.2)
