# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a calibration is said with the file, the place in it and the key: one table for all formats.

`test_damaged_files.py` has the law that nothing which is broken is read; here is what is said about it.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from tests.cameras.calibration_samples import TEXTS, dump, dumped, put, sample
from tests.cameras.test_understood import read

OCAM = TEXTS["lens.txt"]
SCALE = "<transform><scale>12.5</scale></transform>"
LENS = "cameras/fisheye_lens_polynomial"  # of Blender
IDENTITY = [[300.0, 0, 159.0], [0, 300.0, 119.0], [0, 0, 1]]

VALUES: dict[str, list[tuple[str, Any, str]]] = {  # file -> the way to a value, what stands there, what is said
    "camchain.yaml": [
        ("cam0/camera_model", "fov", "cam0, camera_model: expected one of pinhole, omni, eucm, ds, got 'fov'"),
        ("cam0/distortion_model", "polynomial", "cam0, distortion_model of a pinhole: expected one of none, radtan"),
        ("cam0/intrinsics", [1.0, 2.0, 3.0], "cam0, intrinsics (fu fv pu pv): expected 4 numbers, got 3"),
        ("cam0/intrinsics", [0.0, 2.0, 3.0, 4.0], "cam0, fu and fv: expected positive focal lengths"),
        ("cam0/distortion_coeffs", [0.1], "cam0, distortion_coeffs: expected 4 coefficients"),
        ("cam0/resolution", [752], "cam0, resolution: expected 2 numbers"),
        ("cam0/rostopic", "/cam1", "two cameras have the rostopic '/cam1'"),
        ("cam0/resolution", [752.5, 480], "cam0, resolution: expected the width and height"),
        ("cam1/T_cn_cnm1/0/0", 2.0, "cam1, T_cn_cnm1: expected a rotation"),
    ],
    "image_02.yaml": [
        ("model_type", "CATADIOPTRIC", "model_type: expected one of MEI, PINHOLE, KANNALA_BRANDT, SCARAMUZZA"),
        ("mirror_parameters/xi", -2.0, "xi: expected numbers above -1"),
        ("image_width", 0, "image_width and image_height: expected the width and height"),
    ],
    "fisheye.yaml": [
        ("Camera.nrpol", 6, "the key 'Camera.a5' is missing"),
        ("Camera.nrinvpol", 3, "Camera.nrinvpol: announces 3 coefficients, but Camera.pol3 is there"),
        ("Camera.nrpol", 0.5, "Camera.nrpol: expected a count"),
        ("Camera.c", 0.0, "Camera.c: expected the first number of the affine part about 1"),
        ("Camera.a0", 209.2, "first coefficient of an OCam polynomial is negative"),
    ],
    "FV.json": [
        ("intrinsic/model", "rectilinear", "intrinsic, model: expected radial_poly, got 'rectilinear'"),
        ("intrinsic/poly_order", 5, "intrinsic: the key 'k5' is missing"),
        ("intrinsic/poly_order", 0.5, "poly_order: expected a count"),
        ("intrinsic/k1", -1.0, "intrinsic: polynomial: expected"),
        ("intrinsic/aspect_ratio", 0.0, "intrinsic: aspect_ratio: expected numbers above 0"),
        ("intrinsic/width", 0.0, "width and height: expected the width and height"),
        ("extrinsic/quaternion/3", 0.0, "quaternion (x, y, z, w): expected a quaternion of length 1"),
    ],
    "transforms.json": [
        ("camera_model", "FISHEYE624", "camera_model: expected one of PINHOLE"),
        ("camera_model", "OPENCV", "k4: expected 0 of the camera_model OPENCV"),
        ("fl_x", -3, "expected positive focal lengths"),
        ("w", 0.5, "w and h: expected the width and height"),
        ("frames/0/fl_x", 300.0, "frames[0], fl_x: expected what the file says for all frames"),
    ],
    "calibration.json": [
        ("value0/intrinsics/0/camera_type", "spherical", "intrinsics[0], camera_type: expected one of ds, eucm, "),
        ("value0/T_imu_cam/0/qw", 0.0, "T_imu_cam[0]: expected a quaternion of length 1"),
        ("value0/resolution", [[160, 128]], "value0, resolution: holds 1 cameras and intrinsics 5"),
    ],
    "config.yaml": [
        ("cameras/0/pose", [0, 0, 0, 0, math.nan, 0], "cameras[0] (cam1), pose: expected finite numbers"),
        ("cameras/0/pose", [0, 0, 0], "cameras[0] (cam1), pose: expected 6 numbers, got 3"),
        ("cameras/0/pose", [0, 90, 0, 0, 0, 0], "cameras[0] (cam1), pose: expected a rotation vector in radians"),
        ("cameras/0/max_fov", 3.49, "max_fov: expected degrees"),
        ("cameras/0/poly", [5, -100.0, 0.0, 0.0025], "direct polynomial: announces 5 coefficients but holds 3"),
        ("cameras/0/model", "pinhole", "model: expected ocam, got 'pinhole'"),
        ("cameras/0/cam_id", 2, "cameras[1] (cam2): a second camera named 'cam2'"),
    ],
    "rig.yaml": [
        ("version", 2, "reads version 1, got 2"),
        ("cameras/0/name", "cam\x1b[31m", "without control characters, got 'cam\\x1b[31m'"),
        ("cameras/0/model", "magic", "cameras[0], model: expected one of"),
    ],
    "spires.yaml": [("sensor/camera_fov", 2.8, "camera_fov: expected degrees")],
    "sensor.yaml": [
        ("sensor_type", "imu", "sensor_type: expected camera, got 'imu'"),
    ],
    "device.json": [
        ("CameraCalibrations", [], "CameraCalibrations: expected a list of at least one entry"),
        ("CameraCalibrations/0/Projection/Name", "Linear", "[0], Projection, Name: expected FisheyeRadTanThinPrism"),
        ("CameraCalibrations/1/T_Device_Camera/UnitQuaternion", [1, [0, 0, 1]],
         "[1], T_Device_Camera, UnitQuaternion: expected a quaternion of length 1"),
    ],
    "calibration_fisheye.json": [
        ("taylor_coefficient", [-337.0, 0.0, 1e-3], "taylor_coefficient: expected the first one above 0"),
        ("stretch_matrix", [[1.0, 0.0]], "stretch_matrix: expected "),
    ],
    "stereo.yaml": [
        ("M1", [[300.0, 0.5, 159.0], *IDENTITY[1:]], "M1: a skew of 0.5 is for fisheye"),
        ("M1", IDENTITY[:2], "M1: expected 9 numbers, got 6"),
        ("M1", [IDENTITY[0], [0.5, 1, 0], [0, 0, 1]], "M1: expected the rows"),
        ("M1", [*IDENTITY[:2], [0, 0, 2]], "M1: expected the rows"),
        ("M1/data", [1.0] * 8, "M1: announces 3 x 3 numbers but holds 8"),
        ("D1", [0.1, 0.2], "D1: expected 4 or 5 coefficients"),
        ("R", [0.0, 45.0, 0.0], "R: expected a rotation vector in radians"),
    ],
    "blender.json": [
        (LENS + "/fisheye_polynomial_k0", 0.01, "fisheye_polynomial_k0: expected 0, as the axis is in the middle"),
        (LENS + "/fisheye_polynomial_k1", -1e100, "k1: expected radians a millimetre, got -1e+100"),
        (LENS + "/fisheye_polynomial_k1", 0.06, "fisheye_polynomial_k1 (negative): expected positive"),
        (LENS + "/panorama_type", "MIRRORBALL", "panorama_type: expected one of FISHEYE_EQUIDISTANT"),
        (LENS + "/shift_x", 0.1, "shift_x and shift_y: expected 0 of a panoramic camera"),
        (LENS + "/sensor_width", 0.0, "sensor_width: expected millimetres above 0"),
    ],
}  # fmt: skip
WORDS: dict[str, list[tuple[str, str, str]]] = {  # file -> what stands in it, what stands there instead, what is said
    "lens.txt": [
        (OCAM, "\n".join(OCAM.splitlines()[:6]), "truncated after line 3: the inverse polynomial"),
        (OCAM, "\n".join(OCAM.splitlines()[:14]), "truncated after line 11: the affine (c d e) is missing"),
        (OCAM, "", "truncated after line 0: the direct polynomial"),
        ("3 -1.000000e+02 0.0", "3 -1.000000e+02", "line 3, direct polynomial (count, then coefficients): announces 3"),
        ("119.5 160.25", "119.5", "line 11, centre (row column): expected 2 numbers, got 1"),
        ("119.5 160.25", "119.5 nan", "line 11, centre (row column): expected finite"),
        ("240 320", "240 wide", "line 19, image size (height width): expected numbers"),
        ("-1.000000e+02", "1.000000e+02", "the first coefficient of an OCam polynomial is negative"),
    ],
    "cameras.txt": [
        ("2 PINHOLE", "2 LENS", "line 5, MODEL: expected one of SIMPLE_PINHOLE, "),
        (" 120.75\n3", "\n3", "line 5: expected fx fy cx cy, the line is too short"),
        ("2 PINHOLE 320 240 300.5", "2 PINHOLE 320 240 wide", "line 5, fx: expected numbers"),
        ("2 PINHOLE 320 240", "2 PINHOLE 320 nan", "line 5, HEIGHT: expected a whole number"),
        ("1 SIMPLE_PINHOLE 320 240 300.5 160 120.5", "1 SIMPLE_PINHOLE 320", "line 4: expected CAMERA_ID MODEL WIDTH"),
        ("\n2 PINHOLE", "\none PINHOLE", "line 5, CAMERA_ID: expected a whole number, got 'one'"),
        ("2 PINHOLE 320 240 300.5", "2 PINHOLE 320 240 -300", "line 5, fx and fy: expected positive focal lengths"),
        ("\n2 PINHOLE", "\n1 PINHOLE", "line 5: a second camera named 'cam1'"),
    ],
    "calib_cam_to_cam.txt": [
        ("D_01: -0.36 ", "D_01: ", "D_01: expected 5 numbers, got 4"),
        ("T_01: 0", "T_01: nan", "T_01: expected finite numbers"),
        ("R_01: 0 0 -1", "R_01: 0 0 -2", "R_01: expected a rotation"),
        ("K_01: 989.5 0.0", "K_01: 989.5 0.5", "K_01: a skew of 0.5"),
        ("T_01:", "T_00:", "line 15: expected a key of its own first, got 'T_00:'"),
        ("corner_dist:", "crop_00:", "'crop_00' is not understood"),
    ],
    "lens.xml": [
        (">frame<", ">fisheye<", "b2 (skew) of a fisheye"),
        ("<f>300</f>", "<f>wide</f>", "f: expected numbers"),
        ("<width>640</width>", "", "width and height: expected the width and height"),
        (">frame<", ">cylindrical<", "type: expected one of frame, fisheye, "),
        ("</calibration>", "", "not valid XML"),
    ],
    "dual.xml": [
        ("master_id", "maste_id", "master_id"),
        ('master_id="0"', 'master_id="7"', "there is no camera '7'"),
        ("<rotation>", "<rotatio>", "not valid XML"),
        ("<location>0 0 -0.004</location>", "", "'location' is missing"),
        (SCALE, SCALE.replace("scale>12.5", "scale>1</scale><scale>12.5"), "scale: expected"),
        (SCALE, SCALE.replace("12.5", "-12.5"), "scale: expected one number above 0"),
        ("<f>300</f>", "<f>300</f><k1>0.1</k1><k9>0.1</k9>", "k9' is not understood"),
        ("<f>300</f>", "<f>300</f><f>310</f>", "f: expected"),
        ('label="front">', 'label="front"><orientation>6</orientation>', "orientation: expected 1"),
        ('version="2.0.0">', 'version="2.0.0"><chunkk/>', "chunkk"),
        ("<components", "<transform><scale>3</scale></transform><components", "scale: expected one number above 0"),
        ('<sensor id="1"', '<sensor id="0"', "sensor 0: a second camera named 'cam0'"),
    ],
    "image001.xmp": [
        ('Skew="0"', 'Skew="0.1"', "Skew: expected 0"),
        ('"brown3t2"', '"division"', "DistortionModel: expected perspective or"),
        ("-0.0105 0 ", "-0.0105 0.3 ", "without a fourth radial coefficient"),
        (">0 -1 0 0 0 -1", ">0 -1 0 0 0", "Rotation: expected 9 numbers, got 8"),
        ('xcr:Skew="0"', 'xcr:Skew="0" xcr:Scale="3"', "'Scale' is not understood"),
    ],
    "front.cameramodel": [
        ("OPENCV5", "SPLINED_STEREOGRAPHIC_order=3", "lensmodel: expected one of"),
        ("-1.5707963267948966", "-90", "extrinsics: expected a rotation vector in radians"),
        ("icam_", "roi_", "'roi_intrinsics' is not understood"),
    ],
    "svo.yaml": [
        ("cameras:", "scale: 0.5\ncameras:", "scale: expected 1"),
        ("type: equidistant", "type: fisheye", "expected one of none, equidistant"),
    ],
    "rig.yaml": [("  projection: equidistant\n", "", "cameras[0]: the key 'projection' is missing")],
    "atan.yaml": [("cam_width", "crop: 1, cam_width", "'crop' is not understood")],
    "okvis.yaml": [("cameras:", "binning: 2\ncameras:", "'binning' is not understood")],
    "settings.yaml": [
        ("Camera.fps", "resize: 2\nCamera.fps", "'resize' is not understood"),
        ("Camera.fps", "LEFT.K: [[1]]\nCamera.fps", "'LEFT.K' is not understood"),
        ("Camera.fps", "Stereo.b: 0.7\nCamera.fps", "Stereo.b: expected the"),
    ],
    "camchain.yaml": [
        ("362.7", "6:02.7", "intrinsics (fu fv pu pv): expected numbers"),
        ("cam1:", "cam7:", "cam2: cam1, the camera before, is missing"),
    ],
    "transforms.json": [
        ('"camera_model": "OPENCV_FISHEYE"', '"camera_angle_x": 1.4', "fl_x and camera_angle_x"),
        ('"w": 512', '"mask_path": "mask.png", "w": 512', "mask_path"),
    ],
    "stereo.yaml": [("\nR:\n", "\ntranslation_unit: m\nR:\n", "translation_unit: ")],
    "blender.json": [
        ('"shift_x"', '"pixel_aspect_x": 2.0, "pixel_aspect_y": 1.0, "shift_x"', "pixel_aspect_x and pixel_aspect_y: "),
    ],
    "lens.json": [
        ('"fps"', '"use_opencv_standard": true, "fps"', "use_opencv_standard: expected none"),
        ('"name"', '"distortion_model": "poly5", "name"', "distortion_model: expected opencv_fisheye"),
        ('stretch": 1.0', 'stretch": 1.33', "input_horizontal_stretch: expected 1"),
    ],
    "reconstruction.json": [("fisheye_opencv", "fisheye62", "projection_type: expected one of")],
    "mc_calib.yaml": [("type: 0\n  camera_group: 0", "type: 0\n  camera_group: 1", "camera_group")],
}  # fmt: skip


def said(tmp_path: Path, name: str, text: str) -> str:
    """What is said about a file, with its name."""
    message = read(dump(tmp_path / name, text))
    assert isinstance(message, str), message
    assert name in message
    return message


@pytest.mark.parametrize(
    ("name", "way", "value", "message"), [(f, *row) for f in VALUES for row in VALUES[f]]
)
def test_a_wrong_value_is_named(tmp_path: Path, name: str, way: str, value: Any, message: str) -> None:
    content = sample(name)
    put(content, way, value)
    assert message in said(tmp_path, name, dumped(content, name))


@pytest.mark.parametrize(("name", "old", "new", "message"), [(f, *row) for f in WORDS for row in WORDS[f]])
def test_wrong_words_are_named(tmp_path: Path, name: str, old: str, new: str, message: str) -> None:
    assert old in TEXTS[name]
    assert message in said(tmp_path, name, TEXTS[name].replace(old, new))
