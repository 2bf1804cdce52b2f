# SPDX-License-Identifier: Apache-2.0
"""What holds of every registered format: what it writes it reads back, and no other format takes it for its own."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from sphericalvision.cameras import (
    BrownConradyCamera,
    Camera,
    CameraRig,
    read_camera,
    read_cameras,
    read_rig,
    save_camera,
    save_rig,
)
from sphericalvision.cameras.calibration.formats import FileFormat, file_formats
from sphericalvision.cameras.calibration.text_files import load, looks_structured
from sphericalvision.core import ArgumentError
from sphericalvision.geometry import invert_transform, transform_from_axis_angle
from tests.laws.camera_laws import directions_seen
from tests.laws.cameras import CAMERAS, CameraCase

FORMATS = list(file_formats())
LENSES = [
    *CAMERAS,
    CameraCase(
        "brown conrady, 4",
        lambda s: BrownConradyCamera(
            [60.0 * s, 61.0], [55.2, 47.1], [-0.12, 0.03, 1e-3, -7e-4], (96, 112), 0.8
        ),
    ),
]
PATHS = {
    "ocamcalib": "camera.txt",
    "colmap": "cameras.txt",
    "asl": "sensor.yaml",
    "nerfstudio": "transforms.json",
    "basalt": "calib.json",
    "native": "any.thing",  # whose name has no say in it
}
CASES = [
    pytest.param(format, case, id=f"{format.name}-{case.name}")
    for format in FORMATS
    for case in LENSES
    if (format.write_camera or format.write_rig)
    and case.make(1.0).model in (format.models or [case.make(1.0).model])
]


def recognizing(path: Path) -> list[str]:
    """Names of the formats that say that a file is theirs."""
    names = [f.name for f in FORMATS if f.recognizes_file and f.recognizes_file(path)]
    content = load(path) if not names and looks_structured(path) else None
    if isinstance(content, dict):
        names += [f.name for f in FORMATS if f.recognizes_keys and f.recognizes_keys(content)]
    return names


def same(camera: Camera, again: Camera) -> None:
    """Same model and size, and pixels to 1e-9 where the first one sees something."""
    points = directions_seen(camera)
    assert (again.model, again.image_size) == (camera.model, camera.image_size)
    torch.testing.assert_close(again.project(points).pixels, camera.project(points).pixels, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("format", "case"), CASES)
def test_a_camera_is_read_back_as_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, format: FileFormat, case: CameraCase
) -> None:
    camera, path = case.make(1.0).to(torch.float64), tmp_path / PATHS.get(format.name, "camera.yaml")
    if not format.write_camera:
        pytest.skip("writes rigs only")
    try:
        save_camera(camera, path, format.name)
    except ArgumentError as error:
        pytest.skip(f"this one has more than the format holds: {error}")
    names = recognizing(path)
    assert names == [format.name]
    monkeypatch.chdir(tmp_path)  # a path without a folder, whose name some cameras have
    cameras = read_cameras(path.name, max_angle=float(camera.max_angle), dtype=torch.float64)
    assert all(cameras)
    same(camera, *cameras.values())
    assert format.name != "native" or read_camera(path, dtype=torch.float64).equals(camera)


@pytest.mark.parametrize(
    "format", [format for format in FORMATS if format.models], ids=lambda format: format.name
)
def test_each_model_of_a_format_is_tried(tmp_path: Path, format: FileFormat) -> None:
    """No model is only said to be written: a camera of it is."""
    for model in format.models:
        written = 0
        for case in LENSES:
            camera = case.make(1.0).to(torch.float64)
            if camera.model == model:
                path = tmp_path / PATHS.get(format.name, "camera.yaml")
                try:
                    if format.write_camera:
                        save_camera(camera, path, format.name)
                    else:
                        save_rig(CameraRig([camera], torch.eye(4)[None]), path, format.name)
                    written += 1
                except ArgumentError:
                    continue
        assert written, model


@pytest.mark.parametrize("turn", [[0.0, 1.2, 0.1], [0.0, 3.14, 1e-3], [1e-9, 0.0, 0.0]], ids=str)
@pytest.mark.parametrize("format", [f for f in FORMATS if f.write_rig], ids=lambda format: format.name)
def test_a_rig_is_read_back_as_written(tmp_path: Path, format: FileFormat, turn: list[float]) -> None:
    """Up to the frame of the world, with the masks if the format holds any: where each is, seen from the first one.

    The package's own format keeps every digit, and the names.
    """
    model = "ocam" if format.name == "omnimvs" else "pinhole"
    lens = next(case for case in LENSES if case.make(1.0).model == model)
    turns = torch.tensor([[0.1, -0.2, 0.3], turn], dtype=torch.float64)
    poses = transform_from_axis_angle(turns, torch.tensor([[0.1, 0.0, 0.02], [-0.1, 0.05, 0.0]]).double())
    cameras = [lens.make(s).to(torch.float64) for s in (1.0, 1.1)]
    mask = torch.rand(cameras[0].image_size, generator=torch.Generator().manual_seed(0)) > 0.5
    names = ["front lens", "cam2"] if format.name == "native" else ["cam1", "cam2"]
    masks = {"cam2": mask} if format.holds_masks else None
    rig = CameraRig(dict(zip(names, cameras, strict=True)), poses, masks)
    folder = tmp_path / "new" / "folder"
    path = folder / PATHS.get(format.name, "rig.yaml") if format.name != "asl" else folder
    save_rig(rig, path, format.name)
    again = read_rig(path, max_angle=0.7, dtype=torch.float64)
    assert len(again) == 2
    for camera, other in zip(rig.cameras.values(), again.cameras.values(), strict=True):
        same(camera.with_max_angle(0.7), other)
    relative = [invert_transform(r.world_from_camera[0]) @ r.world_from_camera[1] for r in (rig, again)]
    torch.testing.assert_close(relative[1], relative[0], rtol=0, atol=1e-12)
    assert list(again.masks) == (again.names[1:] if format.holds_masks else [])
    assert all(torch.equal(found, mask) for found in again.masks.values())
    assert format.name != "native" or (again.names == names and torch.equal(again.world_from_camera, poses))


def test_a_name_is_given_once() -> None:
    with pytest.raises(ArgumentError, match=r"'kalibr' is .*already"):
        FileFormat("kalibr", "another").register()
