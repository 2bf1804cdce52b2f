# SPDX-License-Identifier: Apache-2.0
"""OCamCalib's text and OmniMVS's config.yaml, written and read back."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
import torch

from sphericalvision.cameras import (
    CameraRig,
    OCamCamera,
    read_camera,
    read_rig,
    save_camera,
    save_rig,
)
from sphericalvision.core import FileFormatError
from sphericalvision.geometry import transform_from_axis_angle


def lens(third: float = 1 / 3) -> OCamCamera:
    return OCamCamera(
        torch.tensor([-100.0 - third, 0.0, 2.5e-3, 1e-9], dtype=torch.float64),
        [157.1, 99.9, third],
        [160.1, 119.3],
        [1.001, 1e-3, -2e-3],
        (240, 320),
        math.radians(100),
    )


def test_text_has_the_row_first_and_five_lines_of_data(tmp_path: Path) -> None:
    save_camera(lens(), tmp_path / "lens.txt", format="ocamcalib")
    lines = [line for line in (tmp_path / "lens.txt").read_text().splitlines() if line and line[0] != "#"]
    assert len(lines) == 5
    assert lines[0].split()[0] == "4"
    assert lines[2] == "119.3 160.1"
    assert lines[4] == "240 320"


def test_polynomials_of_two_lenses_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "lens.txt"
    save_camera(lens(), path, format="ocamcalib")
    path.write_text(path.read_text().replace("157.1", "197.1"))
    with pytest.raises(FileFormatError, match=r"lens\.txt: the direct and the inverse polynomial contradict"):
        read_camera(path)


@pytest.mark.parametrize("names", [["cam1", "cam3"], ["front", "right"]])
def test_names_with_a_number_and_fields_of_view_are_kept(tmp_path: Path, names: list[str]) -> None:
    poses = transform_from_axis_angle(
        torch.zeros(2, 3).double(), torch.tensor([[0.1, 0, 0], [0, 0, -0.1]]).double()
    )
    rig = CameraRig(dict(zip(names, (lens(), lens(0.3)), strict=True)), poses)
    save_rig(rig, tmp_path / "config.yaml", format="omnimvs")
    again = read_rig(tmp_path, dtype=torch.float64)
    assert again.names == (names if names[0] == "cam1" else ["cam1", "cam2"])
    torch.testing.assert_close(again.max_angles, rig.max_angles, rtol=0, atol=1e-15)
    text = (tmp_path / "config.yaml").read_text()
    (tmp_path / "config.yaml").write_text(re.sub("max_fov: .*", "max_fov: 3.49", text))
    with pytest.raises(FileFormatError, match="max_fov: expected degrees"):
        read_rig(tmp_path)
