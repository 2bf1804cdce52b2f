# SPDX-License-Identifier: Apache-2.0
"""What makes no rig, or no camera, is refused with what is missing: files of folders in one table."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from sphericalvision.cameras import CameraRig, convert, read_camera, read_rig, ring_rig, save_rig
from sphericalvision.core import ArgumentError, SphericalVisionError
from tests.cameras.calibration_samples import KALIBR, TEXTS, dump, sample
from tests.cameras.test_format_rigs import (
    HALVES,
    KITTI360,
    MEI,
    MULTICOL,
    OCAM,
    PHOTO,
    POSES_CM,
    STEREO,
    UNUSED,
    VINS,
    Files,
    write,
)
from tests.cameras.test_understood import FIVE, MESSAGE

GROUP = '<group id="0" label="second"><camera id="7" sensor_id="0" label="DSC_1"><transform>'
GROUP += "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera></group></cameras>"
NO_POSE = {key: value for key, value in sample("FV.json").items() if key != "extrinsic"}
NO_TRANSFORM = {key: value for key, value in sample("settings.yaml").items() if key != "Stereo.T_c1_c2"}
MASKED = sample("rig.yaml")
MASKED["cameras"][0]["mask"] = "front.png"
ALL_BAD = sample("transforms.json")
for _frame in ALL_BAD["frames"]:
    _frame["is_bad"] = True


def vins(**changes: Any) -> Files:
    return VINS | {"estimator.yaml": VINS["estimator.yaml"] | changes, "note.yaml": "nothing: 1"}


def split_by(key: str, values: str) -> Files:
    """Frames of a file with values of an identifier."""
    frame = sample("transforms.json")["frames"][0]
    frames = [{**frame, "file_path": f"{k}.png", key: int(value)} for k, value in enumerate(values)]
    return {"transforms.json": sample("transforms.json", frames=frames)}


REFUSED: list[tuple[Files, dict[str, Any], str, str]] = [  # files, what is given, the path, what is said
    (OCAM | {"poses.txt": POSES_CM}, {}, ".", "pass 'm', 'cm' or 'mm'"),
    (OCAM | {"poses.txt": POSES_CM}, {"translation_unit": "inch"}, ".", "'m', 'cm', 'mm'"),
    (OCAM | {"poses.txt": POSES_CM.replace("20 0 -20", "nan 0 -20", 1)}, {"translation_unit": "cm"}, ".",
     "poses.txt, line 2: expected finite numbers"),
    (OCAM | {"poses.txt": POSES_CM.replace("1.57", "90", 1)}, {"translation_unit": "cm"}, ".",
     "poses.txt, line 2: expected a rotation vector in radians"),
    (OCAM | {"poses.txt": POSES_CM.replace("0 0 -40", "0 -40")}, {"translation_unit": "cm"}, ".",
     "poses.txt, line 3: expected 6 numbers, got 5"),
    ({name: OCAM[name] for name in list(OCAM)[:3]} | {"poses.txt": POSES_CM}, {"translation_unit": "cm"}, ".",
     "holds 4 poses, but the folder has 3 cameras (ocam1.txt, ocam2.txt, ocam3.txt)"),
    (OCAM | {"poses.txt": "# translation_unit: cm\n" + POSES_CM}, {"translation_unit": "mm"}, ".",
     "says 'cm' itself, got 'mm'; leave it out"),
    (OCAM | {"poses.txt": "# translation_unit: inch\n" + POSES_CM}, {}, ".", "poses.txt: translation_unit: expected"),
    (OCAM | {"poses.txt": POSES_CM, "config.yaml": TEXTS["config.yaml"]}, {"translation_unit": "cm"}, ".",
     "poses.txt and config.yaml, which may differ in scale; name the one to read"),
    (HALVES | {"extrinsics.yml": HALVES["extrinsics.yml"] | {"D1": [0.1]}}, {"translation_unit": "m"}, ".",
     "different values of D1"),
    ({"config.yaml": TEXTS["config.yaml"]}, {"translation_unit": "cm"}, "config.yaml", "in metres by its format"),
    ({}, {}, "nothing", "no such file or folder"),
    ({}, {}, ".", "none of rig.yaml, sensor.yaml, calibration.json"),
    ({f"{k}/cameras.txt": "" for k in "01"}, {}, ".", "there are 0/cameras.txt, 1/cameras.txt; name"),
    ({f"sparse/{k}/cameras.txt": "" for k in "01"}, {}, ".", "there are sparse/0/cameras.txt, sparse/1/cameras.txt"),
    ({"right.yaml": "", "left.yaml": ""}, {}, ".", "there are right.yaml, left.yaml; name"),
    ({f"transforms_{k}.json": sample("transforms.json") for k in ("a", "b")}, {}, ".", "transforms_b.json; name"),
    ({"other.yaml": {"a": 1}}, {}, "other.yaml", "not a calibration; known are"),
    ({"factory_calibration.json": "{}"}, {}, ".", "there are factory_calibration.json; name"),
    ({"torn.json": '{"value0": '}, {}, "torn.json", "not valid json"),
    ({"torn.yaml": "a: [1, 2"}, {}, "torn.yaml", "not valid YAML"),
    ({"camera.xml": "<?xml version='1.0'?><settings/>"}, {}, "camera.xml", "not a calibration"),
    ({"camera.xml": "<?xml version='1.0'?><opencv_storage><a>"}, {}, "camera.xml", "not valid XML"),
    ({"camera.xml": "<?xml version='1.0'?><!DOCTYPE a [<!ENTITY b 'c'>]><opencv_storage/>"}, {}, "camera.xml",
     "no document type"),
    ({"lens.txt": TEXTS["lens.txt"]}, {}, "lens.txt", "holds one camera without poses"),
    ({"image_02.yaml": MEI}, {}, "image_02.yaml", "use read_camera"),
    ({"camchain.yaml": {"cam0": KALIBR["ds none"]}}, {}, ".", "holds one camera without poses"),
    ({"stereo.yaml": {key: value for key, value in STEREO.items() if key != "R"}}, {"translation_unit": "mm"},
     "stereo.yaml", "holds 2 cameras without poses"),
    ({"stereo.yaml": STEREO}, {}, "stereo.yaml", "translation_unit: "),
    ({"settings.yaml": NO_TRANSFORM}, {}, "settings.yaml", "holds 2 cameras without poses"),
    ({"calib_cam_to_pose.txt": KITTI360}, {}, ".", "image_02.yaml"),
    ({"calib_cam_to_pose.txt": KITTI360.replace("-0.3 0.0 -1.0 0.0 -1.5", "-0.3 0.0"), "image_02.yaml": MEI}, {}, ".",
     "line 2, image_02: expected 4 rows of 4 numbers, got 9"),
    ({f"{k}_FV.json": sample("FV.json", name="FV") for k in (1, 2)}, {}, ".",
     "a second camera named 'FV' (the first is in 1_FV.json)"),
    *(({"calib_cam_to_pose.txt": f"image_02: {row}", "image_02.yaml": MEI}, {}, ".", "line 1, image_02")
      for row in ("nan 0 0 0 0 1 0 0 0 0 1 0", "2 0 0 0 0 1 0 0 0 0 1 0", "words 0 0 0 0 1 0 0 0 0 1 0")),
    ({"FV.json": NO_POSE}, {}, "FV.json", "without poses"),
    ({"FV.json": NO_POSE}, {}, ".", "no pose of this camera"),
    ({name: MULTICOL[name] for name in MULTICOL if "1" not in name}, {}, ".",
     "InteriorOrientationFisheye1.yaml: no such file"),
    (MULTICOL | {"InteriorOrientationFisheye0.yaml": "- 1\n- 2\n"}, {}, ".",
     "InteriorOrientationFisheye0.yaml: expected keys"),
    ({"rig.yaml": MASKED}, {}, "rig.yaml", "front.png: no such file"),
    (vins(cam1_calib="other.yaml"), {}, "estimator.yaml", "other.yaml"),
    (vins(cam1_calib="note.yaml"), {}, "estimator.yaml", "estimator.yaml names it for cam1"),
    ({"s.yaml": sample("settings_pinhole.yaml") | {"Camera.bFishEye": 1}}, {}, "s.yaml", "bFishEye"),
    (vins(cam0_calib=3), {}, "estimator.yaml", "estimator.yaml, cam0_calib: expected the name of a file"),
    ({"a.xml": UNUSED.replace("</cameras>", f"{PHOTO}</cameras>")}, {}, "a.xml", "camera 'pano': expected a sensor"),
    ({"a.xml": TEXTS["chunk.xml"].replace("</cameras>", GROUP)}, {}, "a.xml", "'DSC_1': a second camera has"),
    ({"transforms.json": ALL_BAD}, {}, ".", "is_bad"),
    *((split_by(key, "1122"), {}, ".", key) for key in ("timestamp_us", "time", "serial_number")),
    ({"reconstruction.json": [sample("reconstruction.json")] * 2}, {}, ".", "holds a list of 2: OpenSfM"),
    ({"a.xml": TEXTS["chunk.xml"].replace("</chunk>", "</chunk><chunk/>")}, {}, "a.xml", "got a list of 2; keep one"),
    ({f"cam{k}/sensor.yaml": TEXTS["sensor.yaml"] for k in ("0", "1", "1_old")}, {}, ".", "cam1_old next to cam0"),
    ({"cam0/sensor.yaml": TEXTS["sensor.yaml"], "rig.yaml": MASKED}, {}, ".", "rig.yaml and cam0/sensor.yaml"),
    ({"info.yaml": MESSAGE | {"distortion_model": "", "d": FIVE[:4]}}, {}, "info.yaml", "distortion_model: expected"),
    ({"a.jsonl": f"{json.dumps(sample('device.json'))}\n" * 2}, {}, "a.jsonl", "several values"),
    ({"a.json": f"{json.dumps(sample('device.json'))}\n" * 2}, {}, "a.json", "keep one"),
]  # fmt: skip


@pytest.mark.parametrize(("files", "given", "path", "said"), REFUSED, ids=lambda value: None)
def test_what_makes_no_rig_is_refused(
    tmp_path: Path, files: Files, given: dict[str, Any], path: str, said: str
) -> None:
    write(tmp_path, files)
    with pytest.raises(SphericalVisionError, match=re.escape(said)):
        read_rig(tmp_path / path, **given)


@pytest.mark.parametrize("key", ["timestamp_us", "time", "serial_number"])
def test_identifiers_that_all_differ_or_agree_are_names(tmp_path: Path, key: str) -> None:
    for values in ("1111", "1234"):
        assert len(read_rig(write(tmp_path, split_by(key, values)) / "transforms.json")) == 4


@pytest.mark.parametrize("name", ["rig (1).yaml", "rig.yml", "rig_old.yaml"])
def test_a_copy_of_a_calibration_is_told(tmp_path: Path, name: str) -> None:
    for file in ("rig.yaml", name):
        write(tmp_path, {file: sample("rig.yaml")})
    with pytest.warns(UserWarning, match=rf"rig\.yaml is read, and not {re.escape(name)}"):
        read_rig(tmp_path)


def test_one_of_several_cameras_is_read_by_name(tmp_path: Path) -> None:
    path = dump(tmp_path / "cameras.txt", TEXTS["cameras.txt"])
    assert read_camera(path, "cam9").model == "kannala_brandt"
    for name, said in (
        (None, "holds 9 cameras; choose one of cam1, cam2"),
        ("cam10", "has no camera 'cam10'"),
    ):
        with pytest.raises(ArgumentError, match=said):
            read_camera(path, name)
    ring_rig().to_yaml(tmp_path / "rig.yaml")
    with pytest.raises(ArgumentError, match="use read_rig"):
        read_camera(tmp_path / "rig.yaml")


def test_text_beside_binary_must_hold_the_same(tmp_path: Path) -> None:
    rig = ring_rig(3, radius=0.1)
    cameras = [convert(camera, to="kannala_brandt").camera for camera in rig.cameras.values()]
    for suffix in ("bin", "txt"):
        save_rig(CameraRig(cameras, rig.world_from_camera), tmp_path / f"cameras.{suffix}", "colmap")
    assert len(read_rig(tmp_path)) == 3
    text = (tmp_path / "cameras.txt").read_text()
    dump(tmp_path / "cameras.txt", text.replace("2 OPENCV_FISHEYE ", "2 OPENCV_FISHEYE 1"))
    with pytest.raises(ArgumentError, match=r"cameras\.bin and cameras\.txt hold different cameras"):
        read_rig(tmp_path)
