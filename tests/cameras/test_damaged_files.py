# SPDX-License-Identifier: Apache-2.0
"""Files of every format, damaged by hypothesis: refused by name, and never with a raw error.

Keys and values are replaced or gone; ``tests/test_generated_files.py`` replaces bytes and words, and cuts files off.
"""

from __future__ import annotations

import copy
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from sphericalvision.cameras import read_cameras, read_rig, ring_rig
from sphericalvision.core import FileFormatError, MissingFileError
from tests.cameras.calibration_samples import (
    COLMAP,
    KITTI,
    MATRIX,
    MRCAL,
    QUARTER_TURN,
    REALITY_CAPTURE,
    adapter,
    aria,
    asl,
    basalt,
    blender,
    camodocal_kannala_brandt,
    camodocal_pinhole,
    camodocal_scaramuzza,
    dumped,
    gyroflow,
    kalibr,
    mc_calib,
    mei,
    multicol,
    multicol_system,
    okvis,
    opencv_stereo,
    opencv_yaml,
    opensfm,
    orbslam,
    py_ocamcalib,
    spires,
    stella_vslam,
    svo,
    svo_of_one,
    transforms,
    with_size,
    woodscape,
)
from tests.cameras.test_calibration import OCAM, omnimvs

JUNK: list[Any] = [
    "words", "", None, [], {}, [[]], float("nan"), float("inf"), -1.0, 0.0, 1e300, True, [1.0], {"a": 1},
    "1e-3", [None], ["x"] * 4, 10**400,
]  # fmt: skip


def opencv_values(**changes: Any) -> dict[str, Any]:
    """What a parsed FileStorage looks like, so that any part of it can be replaced."""
    values: dict[str, Any] = {}
    for key, value in opencv_stereo(**changes).items():
        if isinstance(value, list):
            rows = value if isinstance(value[0], list) else [[number] for number in value]
            data = [float(number) for row in rows for number in row]
            value = {"rows": len(rows), "cols": len(rows[0]), "dt": "d", "data": data}
        values[key] = value
    return values


def own_rig() -> dict[str, Any]:
    """A rig as the package writes it."""
    with tempfile.TemporaryDirectory() as folder:
        ring_rig(2).to_yaml(Path(folder) / "rig.yaml")
        return dict(yaml.safe_load((Path(folder) / "rig.yaml").read_text()))


CONTENTS: dict[str, Callable[[], dict[str, Any]]] = {
    "camchain.yaml": lambda: kalibr("pinhole radtan", "ds none", "omni radtan", "pinhole equidistant"),
    "calibration.json": lambda: basalt("ds", "eucm", "kb4", "ucm", "pinhole"),
    "image_02.yaml": mei,
    "pinhole.yaml": camodocal_pinhole,
    "kannala.yaml": camodocal_kannala_brandt,
    "scaramuzza.yaml": camodocal_scaramuzza,
    "stella.yaml": stella_vslam,
    "nested.yaml": lambda: stella_vslam(nested=True),
    "FV.json": woodscape,
    "sensor.yaml": asl,
    "device.json": aria,
    "settings.yaml": orbslam,
    "settings_pinhole.yaml": lambda: orbslam("PinHole"),
    "transforms.json": transforms,
    "calibration_fisheye.json": py_ocamcalib,
    "blender.json": blender,
    "fisheye.yaml": multicol,
    "okvis.yaml": okvis,
    "svo.yaml": svo,
    "atan.yaml": svo_of_one,
    "mc_calib.yaml": mc_calib,
    "reconstruction.json": opensfm,
    "DS.yml": adapter,
    "lens.json": gyroflow,
    "spires.yaml": spires,
    "config.yaml": omnimvs,
    "basalt.json": lambda: basalt("ds", "kb4"),
    "rig.yaml": own_rig,
    "stereo.yaml": opencv_values,
    "stereo.json": lambda: opencv_values(
        xi_1=1.2, xi_2=0.9, D1=[0.1, 0.0, 0.0, 0.0], D2=[0.1, 0.0, 0.0, 0.0]
    ),
}
TEXTS: dict[str, str] = {
    **{name: dumped(make(), name) for name, make in CONTENTS.items()},
    "cameras.txt": COLMAP,
    "calib_cam_to_cam.txt": KITTI,
    "image001.xmp": REALITY_CAPTURE,
    "front.cameramodel": MRCAL,
    "plain.yml": opencv_yaml(image_width=320, image_height=240, camera_matrix=MATRIX, dist_coeffs=[0.1] * 5),
    "plain.xml": "<?xml version='1.0'?><opencv_storage><image_width>320</image_width><image_height>240"
    "</image_height><camera_matrix type_id='opencv-matrix'><rows>3</rows><cols>3</cols><dt>d</dt>"
    f"<data>{' '.join(str(number) for row in MATRIX for number in row)}</data></camera_matrix></opencv_storage>",
}


def read_everything(path: Path) -> None:
    """As a camera and, where the file has poses, as a rig."""
    with_size(read_cameras, path, max_angle=1.0)
    if path.name not in (
        "cameras.txt",
        "plain.yml",
        "plain.xml",
        "pinhole.yaml",
        "kannala.yaml",
        "scaramuzza.yaml",
        "stella.yaml",
        "nested.yaml",
        "fisheye.yaml",
        "calibration_fisheye.json",
        "atan.yaml",
        "DS.yml",
        "lens.json",
    ):
        unit = "mm" if path.stem in ("stereo", "mc_calib") else None
        if path.name != "image_02.yaml":
            with_size(read_rig, path, max_angle=1.0, translation_unit=unit)


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


@pytest.mark.parametrize("name", TEXTS)
def test_intact_file_is_read(name: str) -> None:
    with written(TEXTS[name], name) as path:
        read_everything(path)


CUT = {"ocam1.txt": OCAM[: OCAM.rindex("240 320") + 4], "basalt.json": TEXTS["basalt.json"]}


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
    name = data.draw(st.sampled_from(sorted(CONTENTS)))
    content: Any = copy.deepcopy(CONTENTS[name]())
    for _ in range(data.draw(st.integers(1, 2))):
        *way, last = data.draw(st.sampled_from(places(content)))
        inner = content
        for key in way:
            inner = inner[key]
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


@pytest.mark.parametrize("damage", ["nan 0 0", "0 0", "2 0 0", "words 0 0"])
def test_poses_of_folders(tmp_path: Path, damage: str) -> None:
    (tmp_path / "image_02.yaml").write_text(yaml.safe_dump(mei()))
    line = "image_02: " + " ".join(f"{' '.join(map(str, row))} 0" for row in QUARTER_TURN)
    path = tmp_path / "calib_cam_to_pose.txt"
    path.write_text(line.replace("0.0 0.0 -1.0", damage, 1))
    with pytest.raises(FileFormatError, match="line 1, image_02"):
        read_rig(tmp_path)


def test_system_with_other_files_beside_it(tmp_path: Path) -> None:
    (tmp_path / "MultiCamSys_Calibration.yaml").write_text(yaml.safe_dump(multicol_system()))
    for index in (0, 1):
        (tmp_path / f"InteriorOrientationFisheye{index}.yaml").write_text("- 1\n- 2\n")
    with pytest.raises(FileFormatError, match=r"InteriorOrientationFisheye0\.yaml: expected keys"):
        read_rig(tmp_path)
    (tmp_path / "InteriorOrientationFisheye0.yaml").unlink()
    with pytest.raises(MissingFileError):
        read_rig(tmp_path)


def test_key_that_stands_twice_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    path.write_text(yaml.safe_dump(kalibr("ds none")) + "cam0: {}\n")
    with pytest.raises(FileFormatError, match=r"the key 'cam0' stands twice.*line \d+"):
        read_rig(path)


def test_yaml_runs_nothing(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    path.write_text("cam0: !!python/object/apply:os.system ['exit 1']\n")
    with pytest.raises(FileFormatError, match="not valid YAML"):
        read_rig(path)


def test_missing_mask_is_named(tmp_path: Path) -> None:
    content = own_rig()
    content["cameras"][0]["mask"] = "front.png"
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(MissingFileError, match=r"front\.png: no such file"):
        read_rig(tmp_path / "rig.yaml")
