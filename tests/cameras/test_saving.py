# SPDX-License-Identifier: Apache-2.0
"""save_camera and save_rig: the choice of a format, batches, masks, and the package's own YAML with every model."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from sphericalvision.cameras import (
    BrownConradyCamera,
    Camera,
    CameraRig,
    DoubleSphereCamera,
    FisheyeCamera,
    KannalaBrandtCamera,
    OCamCamera,
    PinholeCamera,
    RadialPolynomialCamera,
    UnifiedCamera,
    convert,
    read_camera,
    ring_rig,
    save_camera,
    save_rig,
)
from sphericalvision.cameras.calibration import CAMERA_FORMATS, RIG_FORMATS
from sphericalvision.cameras.calibration.poses import axis_angle_from_rotation, quaternion_from_rotation
from sphericalvision.core import ArgumentError
from sphericalvision.geometry import transform_from_axis_angle

SIZE = (240, 320)
CENTER = [160.3, 119.7]
PLAIN = BrownConradyCamera([300.1, 299.9], CENTER, [-0.1, 0.02, 1e-3, -1e-3, 0.01], SIZE)
POLYNOMIAL = RadialPolynomialCamera([99.0, -9.0, 14.0, -2.1], CENTER, 1.01, SIZE)


def test_batches_are_refused(tmp_path: Path) -> None:
    batch = KannalaBrandtCamera(torch.ones(2, 2), torch.ones(2, 2), torch.zeros(2, 4), SIZE, 1.0)
    for format in CAMERA_FORMATS:
        with pytest.raises(ValueError, match=r"got a batch \(2,\); .*camera\.select"):
            save_camera(batch, tmp_path / "camera.yaml", format=format)
    for format in RIG_FORMATS:
        with pytest.raises(ValueError, match=r"got a batch .*rig\.select"):
            save_rig(CameraRig.stack([ring_rig(), ring_rig()]), tmp_path / "rig.yaml", format=format)


@pytest.mark.parametrize("format", RIG_FORMATS[1:])
def test_model_that_no_other_format_has_is_sent_to_native(tmp_path: Path, format: str) -> None:
    pair = CameraRig([POLYNOMIAL] * 2, torch.eye(4).repeat(2, 1, 1))
    with pytest.raises(ValueError, match=rf"'{format}' has no radial_polynomial model.*as 'native'.*convert"):
        save_rig(pair, tmp_path / "rig.yaml", format=format)
    assert not list(tmp_path.iterdir())


def rig_of(*cameras: Camera) -> CameraRig:
    return CameraRig(list(cameras), torch.eye(4).repeat(len(cameras), 1, 1))


PINHOLE = PinholeCamera([300.0, 300.0], CENTER, SIZE)
FISHEYE = FisheyeCamera("equisolid", 100.0, [1.0, 1.0], SIZE, 1.0)
SPHERE = DoubleSphereCamera([100.0, 100.0], CENTER, -0.2, 0.6, SIZE, 1.5)
MEI = UnifiedCamera([100.0, 100.0], CENTER, 1.0, [0.1, 0.0, 0.0, 0.0, 0.01], SIZE)
OCAM = OCamCamera([-100.0, 0.0, 0.0025], None, CENTER, [1.0, 0.0, 0.0], SIZE, 1.0)
KB = KannalaBrandtCamera([100.0, 100.0], CENTER, [0.0] * 4, SIZE, 1.5)
PRISM = BrownConradyCamera([300.0, 300.0], CENTER, [*[0.0] * 8, 0.01, 0, 0, 0], SIZE, 0.4)


@pytest.mark.parametrize(
    ("format", "thing", "message"),
    [
        ("kalibr", PLAIN, "holds fx fy cx cy k1 k2 p1 p2, and this one has k3="),
        ("basalt", OCAM, r"'basalt' has no ocam model.*'native' or 'ocamcalib' or 'omnimvs'"),
        ("basalt", MEI, "holds fx fy cx cy xi, and this one has k1="),
        ("colmap", SPHERE, r"'basalt' or 'kalibr'.*convert\(camera, to=\.\.\.\)"),
        ("colmap", PRISM, "this one has s1="),
        ("opencv", MEI, "holds 4 numbers of distortion"),
        ("opencv", rig_of(PLAIN, PLAIN, PLAIN), "one camera or two, this rig has 3"),
        ("ocamcalib", FISHEYE, r"'ocamcalib' has no fisheye model, it has ocam.*convert\(camera"),
        ("ocamcalib", OCAM, "fit_inverse_polynomial"),
        ("omnimvs", rig_of(OCAM), "fit_inverse_polynomial"),
        ("orbslam", rig_of(KB, PINHOLE), "two of one model"),
        ("nerfstudio", rig_of(KB, PINHOLE), "nerfstudio has one camera model for all frames"),
    ],
)
def test_what_a_format_cannot_hold_is_refused_with_a_way_out(
    tmp_path: Path, format: str, thing: Camera | CameraRig, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        (save_camera if isinstance(thing, Camera) else save_rig)(thing, tmp_path / "file.yaml", format)  # type: ignore[operator]
    assert not list(tmp_path.iterdir())


def test_masks_that_are_not_written_are_told(tmp_path: Path) -> None:
    mask = {"cam1": torch.ones(SIZE, dtype=torch.bool)}
    rig = CameraRig([PinholeCamera([300.0, 300.0], [159.5, 119.5], SIZE)], torch.eye(4)[None], mask)
    with pytest.warns(UserWarning, match=r"'kalibr' holds no masks, those of cam1 are not written"):
        save_rig(rig, tmp_path / "camchain.yaml", format="kalibr")


def test_nothing_of_another_rig_is_read_as_of_the_last_one(tmp_path: Path) -> None:
    """Of three cameras with a mask first, then of two without; nor is anything written beside a folder."""
    lens = KannalaBrandtCamera([100.0, 100.0], [31.5, 31.5], [0.0] * 4, (64, 64))
    poses = transform_from_axis_angle(torch.zeros(3, 3), torch.eye(3) / 10)
    usable = torch.ones(64, 64, dtype=torch.bool)
    usable[:9] = False
    three = CameraRig([lens] * 3, poses, {"cam2": usable})
    save_rig(three.replaced(masks={}), tmp_path / "mav0", "asl")
    with pytest.raises(ArgumentError, match=r"path: .*cam2/sensor.yaml would be one more camera"):
        save_rig(three.subset(["cam1", "cam3"]), tmp_path / "mav0", "asl")
    save_rig(three, tmp_path / "rig.json", "basalt")
    with pytest.raises(ArgumentError, match=r"path: .*cam1/mask.png would be taken for the mask of cam2"):
        save_rig(three.replaced(masks={}), tmp_path / "rig.json", "basalt")
    ocam = dict.fromkeys(three.names, convert(lens, to="ocam").camera)
    save_rig(three.replaced(ocam), tmp_path / "config.yaml", "omnimvs")
    with pytest.raises(ArgumentError, match=r"path: .*mask2.png would be taken for the mask of cam2"):
        save_rig(three.replaced(ocam, masks={}), tmp_path / "config.yaml", "omnimvs")
    files = {*tmp_path.iterdir()}
    for rig, format in ((three, "native"), (three, "basalt"), (three.replaced(ocam), "omnimvs")):
        with pytest.raises(ArgumentError, match=r"path: .*mav0 is a folder; name a file in it"):
            save_rig(rig, tmp_path / "mav0", format)
    assert files == {*tmp_path.iterdir()}  # of masks as well


def test_learned_intrinsics_are_written(tmp_path: Path) -> None:
    focal = torch.tensor([300.0, 301.0], requires_grad=True)
    for format in ("native", "basalt", "kalibr", "opencv", "colmap"):
        path = tmp_path / ("cameras.txt" if format == "colmap" else "camera.yaml")
        path = path.with_suffix(".json") if format == "basalt" else path
        save_camera(PinholeCamera(focal, [159.5, 119.5], SIZE), path, format=format)
        camera = read_camera(path)
        assert isinstance(camera, PinholeCamera)
        assert camera.focal_length.tolist() == [300.0, 301.0]


@pytest.mark.parametrize("degrees", [0.0, 1e-7, 1e-3, 45.0, 120.0, 179.0, 180.0 - 1e-7, 180.0])
def test_rotations_become_quaternions_and_vectors_to_the_last_digits(degrees: float) -> None:
    axis = torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64)
    vector = axis * torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
    rotation = transform_from_axis_angle(vector[None], torch.zeros(1, 3, dtype=torch.float64))[0, :3, :3]
    w, x, y, z = quaternion_from_rotation(rotation)
    assert w >= 0
    assert w * w + x * x + y * y + z * z == pytest.approx(1.0, abs=1e-14)
    found = torch.tensor(axis_angle_from_rotation(rotation), dtype=torch.float64)
    angle = found.norm()
    skew = torch.linalg.cross(
        torch.eye(3, dtype=torch.float64), (found / angle.clamp_min(1e-300)).expand(3, 3)
    )
    rodrigues = torch.eye(3, dtype=torch.float64) + angle.sin() * skew + (1 - angle.cos()) * skew @ skew
    torch.testing.assert_close(rodrigues, rotation, rtol=0, atol=2e-15)
