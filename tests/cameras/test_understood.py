# SPDX-License-Identifier: Apache-2.0
"""What is read is understood or refused aloud: no key of a file is dropped that the camera depends on."""

from __future__ import annotations

import copy
import math
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from sphericalvision.cameras import BrownConradyCamera, Camera, CameraRig, read_camera
from sphericalvision.core import FileFormatError, SphericalVisionError
from tests.cameras.calibration_samples import KEYED, TEXTS, at, dump, dumped, read_sample, sample
from tests.cameras.test_damaged_files import places


def read(path: Path) -> Any:
    """The rig or the cameras of a file, or what is said against it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return read_sample(path)
        except SphericalVisionError as error:
            return str(error)


def same(first: Any, second: Any) -> bool:
    """Whether both are the same cameras at the same places."""
    if isinstance(first, CameraRig) and isinstance(second, CameraRig):
        return same(first.cameras, second.cameras) and torch.equal(
            first.world_from_camera, second.world_from_camera
        )
    if isinstance(first, dict) and isinstance(second, dict):
        return list(first) == list(second) and all(same(first[name], second[name]) for name in first)
    return isinstance(first, Camera) and isinstance(second, Camera) and first.equals(second)


def changed(value: Any) -> Any:
    """Another value of the same kind."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float):
        return type(value)(value * 2 + 1)
    if isinstance(value, dict):
        return {key: changed(inner) for key, inner in value.items()}
    return [changed(inner) for inner in value] if isinstance(value, list) else f"{value}x"


JUNK: tuple[Any, ...] = ("words", [], math.nan, None)
"""In place of a value; the last one, in place of the first number of a list."""


def damages(content: Any) -> Iterator[tuple[str, str, str, Any]]:
    """A kind of damage, the key, what it became, and the file; each key once, wherever it stands first."""
    seen: set[str] = set()
    for *way, last in places(content):
        if not isinstance(last, str) or last in seen or way[-1:] in (["cameras"], ["shots"]):
            continue
        seen.add(last)
        middle = (len(last) + 1) // 2
        words = [("removed", ""), ("misspelt", f"{last}s"), ("misspelt", last[:middle] + last[middle + 1 :])]
        for junk in JUNK:
            damaged = copy.deepcopy(content)
            inner = at(damaged, way)
            is_list = isinstance(inner[last], list) and any(isinstance(x, float) for x in inner[last][:1])
            inner[last] = [junk, *inner[last][1:]] if junk is None and is_list else junk
            yield "junk", last, "", damaged
        for kind, key in [*words, ("neighbour", f"{last}2"), ("neighbour", f"{last}_new")]:
            damaged = copy.deepcopy(content)
            inner = at(damaged, way)
            if key in inner or (kind == "misspelt" and not key):
                continue
            value = inner[last] if kind == "neighbour" else inner.pop(last)
            if key:
                inner[key] = changed(value) if kind == "neighbour" else value
            yield kind, last, key, damaged


ANYTHING = r"(?i)(.*\W)?(\w*name|label|cam_id|file_path|asymmetrical|inv_poly|D[12]|k4)"
"""Keys that may say anything, or nothing."""
COMPLETE_WITHOUT = {  # keys of which the rest is a file as its producers write it, too
    "camchain.yaml": r"cam\d",
    "config.yaml": "inv_poly",
    "svo.yaml": "label",
    "reconstruction.json": r"c_[xy]|shots",
    "lens.json": "asymmetrical",
    "FV.json": "aspect_ratio|extrinsic",
    "sensor.yaml": "T_BS",
    "settings.yaml": "Stereo.T_c1_c2",
    "settings_pinhole.yaml": "Stereo.T_c1_c2",
    "transforms.json": "fl_[xy]|c[xy]|k4",
    "calibration_fisheye.json": "camera_name",
    "blender.json": "resolution_percentage|matrix_world",
    "stereo.yaml": "D[12]|[RT]",
    "stereo.json": "D[12]|[RT]",
    "image_02.yaml": "camera_name",
    "pinhole.yaml": "camera_name",
    "kannala.yaml": "camera_name",
    "stella_perspective.yaml": "name",
}


@pytest.mark.parametrize("name", KEYED)
def test_each_key_is_understood_or_refused_by_name(tmp_path: Path, name: str) -> None:
    path, content = tmp_path / name, sample(name)
    intact = read(dump(path, content))
    assert not isinstance(intact, str), intact
    assert same(intact, read(dump(path, {"_source": "a comment, as JSON has it", **content})))
    for kind, last, key, damaged in damages(content):
        found = read(dump(path, damaged))
        told = f"{kind}: {last} {key}: {found}"
        if isinstance(found, str):
            assert (
                last in found
                or (key and key in found)
                or "not a calibration" in found
                or last[0] == "M"
                or "distortion" in last
            ), told
        elif not re.fullmatch(
            ANYTHING if kind == "junk" else COMPLETE_WITHOUT.get(name, "") if kind == "removed" else "", last
        ):
            assert same(intact, found), told


NAMES = {  # of elements and attributes, or of keys, in files that are neither YAML nor JSON
    ".xml": r"<([A-Za-z_][\w:.-]*)|\s([A-Za-z_][\w:.-]*)=\"",
    ".xmp": r"<([A-Za-z_][\w:.-]*)|\s([A-Za-z_][\w:.-]*)=\"",
    ".txt": r"(?m)^(\w+):|()$",
    ".cameramodel": r"'(\w+)'\s*:|\b(\w+)\s*:",
}
OTHERS = [
    name
    for name in TEXTS
    if Path(name).suffix in NAMES and name not in ("cameras.txt", "lens.txt", "dual.xml")
]
MAY_BE_REMOVED = {  # Metashape leaves out what it did not estimate, and a chunk may have no scale
    "image001.xmp": "xcr:AspectRatio",
    "lens.xml": r"c[xy]|[kpb]\d",
    "chunk.xml": r"c[xy]|[kp]\d|camera|transform|scale",
}


def text_damages(text: str, suffix: str) -> Iterator[tuple[str, str, str]]:
    """A kind of damage, the name, and the text: misspelt everywhere, removed once, or with a neighbour like it."""
    for name in dict.fromkeys(found[1] or found[2] for found in re.finditer(NAMES[suffix], text) if found[0]):
        middle, word = (len(name) + 1) // 2, re.escape(name)
        for other in (f"{name}s", name[:middle] + name[middle + 1 :]):
            if other:
                yield "misspelt", name, re.sub(rf"(?<![\w:.-]){word}(?![\w:.-])", other, text)
        for kind, old, new in (
            ("removed", rf"(?s)<{word}(\s[^>]*)?/>|<{word}(\s[^>]*)?>.*?</{word}>", ""),
            ("removed", rf"\s{word}=\"[^\"]*\"", ""),
            ("removed", rf"(?m)^{word}:.*\n", ""),
            ("neighbour", rf"(\s){word}=\"([^\"]*)\"", rf'\1{name}="\2" {name}2="9\2"'),
            ("neighbour", rf"(?s)(<{word}(?:\s[^>]*)?>([^<]*)</{word}>)", rf"\1<{name}2>9\2</{name}2>"),
            ("neighbour", rf"(?m)^{word}(:.*\n)", rf"{name}\1{name}2\1"),
        ):
            yield kind, name, re.sub(old, new, text, count=1)


@pytest.mark.parametrize("name", OTHERS)
def test_each_name_of_other_files_is_understood_or_refused(tmp_path: Path, name: str) -> None:
    path, text = tmp_path / name, TEXTS[name]
    intact, tried = read(dump(path, text)), 0
    assert not isinstance(intact, str), intact
    for kind, key, damaged in text_damages(text, path.suffix):
        if damaged == text or (kind == "removed" and re.fullmatch(MAY_BE_REMOVED.get(name, ""), key)):
            continue
        found, tried = read(dump(path, damaged)), tried + 1
        assert isinstance(found, str) or same(intact, found), f"{kind}: {key}: {found}"
    assert tried > 10


COLMAP_MODEL = {
    "cameras.txt": "# a\n1 OPENCV_FISHEYE 640 480 300 301 320 240 0.01 0.02 0.03 0.04\n2 PINHOLE 64 48 30 31 32 24\n",
    "images.txt": "1 1 0 0 0 0.1 0.2 0.3 1 a.png\n1.5 2.5 -1 3.5 4.5 7\n2 0.6 0 0.8 0 0.4 0.5 0.6 2 b.png\n\n",
    "rigs.txt": "1 3 CAMERA 1 CAMERA 2 1 0.6 0 0.8 0 0.4 0.5 0.6 IMU 1 1 1 0 0 0 0 0 0\n",
}


@pytest.mark.parametrize("name", COLMAP_MODEL)
def test_each_word_of_colmap_is_understood_or_refused(tmp_path: Path, name: str) -> None:
    """A word or a line that is missing or stands twice is refused, unless it is of an IMU, a point or a name."""
    for other, text in COLMAP_MODEL.items():
        if not (name == "images.txt" and other == "rigs.txt"):
            (tmp_path / other).write_text(text)
    intact, text = read(tmp_path), COLMAP_MODEL[name]
    assert not isinstance(intact, str), intact
    for place in re.finditer(r"\S+ ?", text):
        for new in ("", f"{place[0].strip()} {place[0]}"):
            (tmp_path / name).write_text(text[: place.start()] + new + text[place.end() :])
            found = read(tmp_path)
            told = f"{place[0]!r} at {place.start()} became {new!r}: {found}"
            assert (
                isinstance(found, str)
                or same(intact, found)
                or ".png" in text[place.start() : place.end() + 5]
            ), told


@pytest.mark.parametrize("name", KEYED)
def test_a_key_that_stands_twice_is_refused(tmp_path: Path, name: str) -> None:
    content = sample(name)
    key = next(iter(content))
    text, more = dumped(content, name), dumped({key: changed(content[key])}, name)
    twice = f"{text[:-1]}, {more[1:]}" if name.endswith("json") else text + more
    assert f"the key {key!r} stands twice" in str(read(dump(tmp_path / name, twice)))


K = [[905.0, 0.0, 498.0], [0.0, 911.0, 402.0], [0.0, 0.0, 1.0]]
FIVE = [0.21, -1.55, 0.012, 0.008, 3.9]
ROS = {"image_width": 960, "image_height": 720, "camera_matrix": K, "distortion_model": "plumb_bob"}


@pytest.mark.parametrize(
    ("matrix", "key"),
    [
        ("cameraMatrix", "dist_coeffs"), ("Camera_Matrix", "distCoeffs"), ("K", "D"), ("K", "dist_coeff"), ("M", "kc"),
        ("K", "distortion"), ("K", "distortion_vector"), ("K", "Distortion_Params"), ("K", "dist_coefs"),
    ],
)  # fmt: skip
def test_a_lens_is_read_under_all_names_of_its_keys(tmp_path: Path, matrix: str, key: str) -> None:
    content = {matrix: K, key: [FIVE], "cameraResolution": [960, 720]}
    camera = read_camera(dump(tmp_path / "camera.yaml", content))
    same_lens = BrownConradyCamera([905.0, 911.0], [498.0, 402.0], FIVE, (720, 960), float(camera.max_angle))
    assert camera.equals(same_lens)


@pytest.mark.parametrize(
    ("model", "count", "found"),
    [
        ("equi", 4, "KannalaBrandtCamera"), ("kannala_brandt4", 4, "KannalaBrandtCamera"),
        ("fisheye", 4, "KannalaBrandtCamera"), ("kb4", 4, "KannalaBrandtCamera"),
        ("radtan", 4, "BrownConradyCamera"), ("plumb_bob", 5, "BrownConradyCamera"),
        ("rational_polynomial", 8, "BrownConradyCamera"), ("thin_prism", 12, "BrownConradyCamera"),
        ("fov", 1, "AtanCamera"), ("none", 0, "PinholeCamera"),
        ("equi", 5, "expected 4 coefficients"), ("plumb_bob", 8, "expected 4 or 5 coefficients"),
        ("thin_prism_fisheye", 8, "got 'thinprismfisheye'"), ("omnidir", 5, "'xi' is missing"),
        ("scaramuzza", 5, "expected one of"), ("none", 4, "expected 0 coefficients"),
    ],
)  # fmt: skip
def test_models_are_those_of_a_closed_list(tmp_path: Path, model: str, count: int, found: str) -> None:
    content = ROS | {"distortion_model": model, "distortion_coefficients": [0.01] * count}
    content["camera_model"] = "pinhole"  # which any camera is to some
    path = dump(tmp_path / "camera.yaml", content)
    if found.endswith("Camera"):
        assert type(read_camera(path)).__name__ == found
    else:
        with pytest.raises(FileFormatError, match=found):
            read_camera(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fisheye_model": 1}, "fisheye_model, distortion_model tell different models"),
        ({"camera_model": "fisheye"}, "distortion_model, camera_model tell different models"),
        ({"dist_coeffs": [0.0] * 5}, "distortion_coefficients and dist_coeffs stand for the same thing"),
        ({"image_size": [480, 360]}, "image_size and image_width, image_height differ"),
        ({"rectified": True}, "'rectified' is not understood"),
        ({"binning_x": 7, "binning_y": 1}, "binning_x and binning_y: 7 and 1 divide no 960 x 720"),
        ({"roi": {"x_offset": 900, "y_offset": 0, "width": 100, "height": 9}}, "roi: .*rectangle inside"),
    ],
)
def test_what_contradicts_or_is_not_known_is_refused(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    content = {**ROS, "distortion_coefficients": FIVE, **changes}
    with pytest.raises(FileFormatError, match=message):
        read_camera(dump(tmp_path / "camera.yaml", content))


MESSAGE = {
    "header": {"frame_id": "cam", "stamp": {"sec": 1}}, "height": 720, "width": 960, "distortion_model": "plumb_bob",
    "d": FIVE, "k": [*K[0], *K[1], *K[2]], "r": [1.0, 0, 0, 0, 1, 0, 0, 0, 1], "p": [0.0] * 12,
    "binning_x": 0, "binning_y": 0,
}  # fmt: skip


def test_messages_of_ros_are_cropped_and_binned(tmp_path: Path) -> None:
    whole = read_camera(dump(tmp_path / "whole.yaml", MESSAGE), max_angle=0.5)
    roi = {"x_offset": 100, "y_offset": 20, "height": 400, "width": 600, "do_rectify": False}
    part = {**MESSAGE, "roi": roi, "binning_x": 2, "binning_y": 2}
    camera = read_camera(dump(tmp_path / "part.yaml", part), max_angle=0.5)
    assert camera.equals(whole.cropped(20, 100, 400, 600).resized((200, 300)))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_printed_messages_end_in_three_lines_and_may_be_several(tmp_path: Path, encoding: str) -> None:
    one, path = yaml.safe_dump(MESSAGE), tmp_path / "camera_info.yaml"
    later = yaml.safe_dump(MESSAGE | {"header": {"stamp": {"sec": 2}}})
    path.write_text(f"{one}---\n{later}---\n", encoding=encoding)
    assert read_camera(path).image_size == (720, 960)
    path.write_text(f"{one}---\n{later.replace('width: 960', 'width: 480')}---\n", encoding=encoding)
    with pytest.raises(FileFormatError, match="2 YAML documents that differ"):
        read_camera(path)


@pytest.mark.parametrize(
    ("encoding", "named"),
    [("cp1252", "line 2: .*0xfc.*cp1252"), ("utf-16-le", "UTF-16 without a byte order mark")],
)
def test_other_encodings_are_named(tmp_path: Path, encoding: str, named: str) -> None:
    (tmp_path / "camera.yaml").write_text(f"# a\n# für\n{yaml.safe_dump(MESSAGE)}", encoding=encoding)
    with pytest.raises(FileFormatError, match=named):
        read_camera(tmp_path / "camera.yaml")
    # A mark alone, and an array
    mark = "\ufeff".encode(encoding.replace("cp1252", "utf-8"))
    for content, kind in ((mark, ""), (np.tile([0.1, 0.0], 9).tobytes(), ".*binary data")):
        (tmp_path / "camera.txt").write_bytes(content)
        with pytest.raises(FileFormatError, match=rf"camera\.txt: {kind}"):
            read_camera(tmp_path / "camera.txt")


@pytest.mark.parametrize(
    ("name", "text", "program"),
    [
        ("rig.json", '{"cameras": [{"id": "cam0", "origin": [0, 0, 0], "forward": [0, 0, -1]}]}', "Facebook Surround"),
        ("camera.txt", "0.53 0.67 0.49 0.5 0.89\n1280 1024\ncrop\n640 480\n", "DSO"),
        ("camera.txt", "EquiDistant 190.9 190.9 254.9 256.8 0.003 0.0 0.0 0.0\n512 512\ncrop\n512 512\n", "DSO"),
        ("chain.yaml", "cam0: {resolution: [640, 480]}\n", "Kalibr"),
        ("report.txt", "Camera-system parameters:\n\tcam0 (/cam0/image_raw):\n", "Kalibr"),
        ("ost.txt", "# oST\n[image]\nwidth\n640\n", "ROS"),
        ("SN1.conf", "[LEFT_CAM_HD]\nfx=700\n", "ZED"),
        ("meta.json", '{"frames": [{"rgb_path": "a.png"}], "sfm_data_version": 1}', "OpenMVG"),
        ("sfm_data.json", '{"sfm_data_version": "0.3", "views": []}', "OpenMVG"),
    ],
)  # fmt: skip
def test_files_of_other_programs_are_named(tmp_path: Path, name: str, text: str, program: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(FileFormatError, match=f"looks like .*{program}"):
        read_camera(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("camchain.yaml", "  rostopic: /cam0", "  rostopic: /cam0\n  line_delay: 1.0e-05"),
        ("camchain.yaml", "[512, 512]", "[0512, 512]"),
        ("camchain.yaml", "cam0:", "T_imu_body: [[1.0]]\ncam0:"),
        ("calibration.json", '"T_imu_cam"', '"T_imu_marker": {"px": 0}, "T_imu_cam"'),
        ("settings.yaml", "Camera.fps: 20", "Camera.fps: 20\nCamera.bFishEye: 1\nORBextractor.scaleFactor: 1.2"),
        ("transforms.json", '"w": 512', '"auto_scale_poses_override": false, "offset": [0.5], "w": 512'),
        ("transforms.json", '"file_path"', '"is_bad": false, "normal_path": "n", "fl_x": 190.98, "file_path"'),
        ("transforms.json", '"w": 512', '"camera_angle_x": 1.4, "w": 512'),  # of a fisheye, where it may mean the view
        ("svo.yaml", "cameras:", "scale: 1.0\ncameras:"),
        ("lens.json", '"fps"', '"use_opencv_standard": false, "digital_lens": null, "fps"'),
        ("reconstruction.json", '"rotation"', '"is_calibrated": true, "merge_cc": 0, "rotation"'),
        ("pinhole.yaml", "model_type", "fisheye: 0\nfisheye_mask: x.jpg\nmin_dist: 30\nmodel_type"),
        ("plain.yml", "image_width", "marker_size: 12.0\nframesCount: 3\nused_imgs: [0]\nimage_width"),
        ("image001.xmp", "xcr:Skew", 'xcr:latitude="48.1" xcr:version="2.2" xcr:Skew'),
        ("panorama.xml", "</height>", "</height><f>916.7324722</f>"),
        ("chunk.xml", "</p2></calibration>", '</p2></calibration><calibration class="initial"><f>9</f></calibration>'),
        ("chunk.xml", "</sensor>", '<rotation fixed="true"/><location fixed="true"/></sensor>'),
        ("chunk.xml", "</sensor>", "<photo_params>b1</photo_params><antenna/></sensor>"),
    ],
)  # fmt: skip
def test_what_producers_write_beside_changes_nothing(tmp_path: Path, name: str, old: str, new: str) -> None:
    path, text = tmp_path / name, TEXTS[name]
    assert old in text
    intact = read(dump(path, text))
    assert same(intact, read(dump(path, text.replace(old, new)))), read(path)
