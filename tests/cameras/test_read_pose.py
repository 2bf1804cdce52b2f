# SPDX-License-Identifier: Apache-2.0
"""One pose in a file, as programs write it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sphericalvision.cameras.robot_frame import read_pose
from sphericalvision.core import ArgumentError, FileFormatError

TURN = Rotation.from_euler("xyz", [0.1, 0.2, 0.3])
POSE = np.eye(4)
POSE[:3, :3], POSE[:3, 3] = TURN.as_matrix(), [0.3, 0.4, 1.2]
TUM = np.concatenate(([12.5], POSE[:3, 3], TURN.as_quat()))[None]

WRITERS: dict[str, Callable[[Path], None]] = {
    "four rows": lambda path: np.savetxt(path, POSE),
    "three rows": lambda path: np.savetxt(path, POSE[:3]),
    "commas": lambda path: np.savetxt(path, POSE, delimiter=","),
    "commas and a header": lambda path: np.savetxt(path, POSE[:3], delimiter=", ", header="base, from rig"),
    "one line": lambda path: np.savetxt(path, POSE[:3].reshape(1, 12)),
    "TUM's": lambda path: np.savetxt(path, TUM),
    "json": lambda path: path.write_text(json.dumps(POSE.tolist())),
    "numpy": lambda path: path.write_text(repr(np.round(POSE, 14)).replace("\n", "\n      ")),
}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_a_pose_is_the_same_however_it_is_written(tmp_path: Path, write: Callable[[Path], None]) -> None:
    write(tmp_path / "base.txt")
    np.testing.assert_allclose(
        read_pose(tmp_path / "base.txt", "frame"), POSE, atol=1e-7 if write is WRITERS["numpy"] else 1e-12
    )


def test_an_offset_that_no_robot_has_is_asked_about(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "base.txt", POSE * [1, 1, 1, 1000] - np.diag([0, 0, 0, 999]))
    with pytest.warns(UserWarning, match=r"frame: .*base\.txt is 1300 m away"):
        read_pose(tmp_path / "base.txt", "frame")


@pytest.mark.parametrize(
    "content",
    [
        np.tile(TUM, (2, 1)),
        np.tile(POSE, (2, 1)),
        POSE[:2],
        POSE[:3, :3],
        2 * POSE,
        POSE * [[1], [1], [-1], [1]],
    ],
    ids=["two of TUM's", "two matrices", "two rows", "a rotation", "millimetres", "a mirror"],
)
def test_what_is_no_single_pose_is_refused(tmp_path: Path, content: np.ndarray) -> None:
    np.savetxt(tmp_path / "base.txt", content)
    with pytest.raises((ArgumentError, FileFormatError), match=r"base\.txt"):
        read_pose(tmp_path / "base.txt", "frame")
