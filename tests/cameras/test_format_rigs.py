# SPDX-License-Identifier: Apache-2.0
"""Where the cameras of files stand: in one file, in several of a folder, and what is said where that is not told."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from sphericalvision.cameras import (
    CameraRig,
    EquirectangularCamera,
    PinholeCamera,
    read_camera,
    read_cameras,
    read_rig,
    save_rig,
)
from sphericalvision.core import FileFormatError, SphericalVisionError
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.io.images import write_mask
from tests.cameras.calibration_samples import (
    KALIBR,
    QUARTER_TURN,
    RIGHT_OF_FIRST,
    TEXTS,
    basalt,
    dump,
    flat,
    kalibr,
    sample,
    storage,
    unit_of,
)

Files = dict[str, Any]
"""Of a folder: texts, or keys with values, by name."""
AXES = {"ahead": [0.0, 0, 1], "right": [1.0, 0, 0], "back": [0.0, 0, -1], "left": [-1.0, 0, 0]}


def write(folder: Path, files: Files) -> Path:
    """The folder, with files in it."""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        dump(folder / name, content)
    return folder


def assert_stand(rig: CameraRig, looking: list[str], positions: Any, tolerance: float = 1e-9) -> None:
    """Cameras look along these axes from these positions, and are upright."""
    axes = torch.tensor([AXES[name] for name in looking]).to(rig.axes)
    torch.testing.assert_close(rig.axes, axes, rtol=0, atol=tolerance)
    torch.testing.assert_close(
        rig.positions, torch.tensor(positions, dtype=rig.axes.dtype), rtol=0, atol=tolerance
    )
    down = torch.tensor([0.0, 1.0, 0.0]).to(rig.axes).expand(len(rig), 3)
    torch.testing.assert_close(rig.world_from_camera[:, :3, 1], down, rtol=0, atol=tolerance)


SECOND = {  # file -> where its second camera stands, of whose samples all look to the right
    **dict.fromkeys(("okvis.yaml", "svo.yaml", "spires.yaml", "mc_calib.yaml"), (0.11, 0.0, 0.0)),
    **dict.fromkeys(("reconstruction.json", "settings.yaml"), (0.11, 0.0, 0.0)),
    **dict.fromkeys(("transforms.json", "calibration.json", "stereo.yaml", "chunk.xml"), (0.1, 0.0, 0.0)),
    "device.json": (0.1, 0.0, 0.02),
    "config.yaml": (0.2, 0.0, 0.0),
    "calib_cam_to_cam.txt": (0.537, 0.0, 0.0),
}


@pytest.mark.parametrize("name", SECOND)
def test_poses_are_camera_to_world_in_metres(tmp_path: Path, name: str) -> None:
    """In every convention the first camera looks ahead, and the second to the right; both are upright."""
    path = dump(tmp_path / name, TEXTS[name])
    rig = read_rig(path, dtype=torch.float64, translation_unit=unit_of(path))
    first = [0.0, 0.0, rig.positions[0, 2].item()]
    assert_stand(rig.subset([0, 1]), ["ahead", "right"], [first, SECOND[name]], 1e-8)


def pose_text(rows: Any) -> str:
    return " ".join(str(value) for row in rows for value in row)


POSES_CM = """0 0 0 0 0 0
0 1.5707963 0 20 0 -20
0 3.1415927 0 0 0 -40
0 -1.5707963 0 -20 0 -20
"""
OCAM = {f"ocam{number}.txt": TEXTS["lens.txt"] for number in range(1, 5)}
KITTI360 = """image_00: 1 0 0 1.57 0 1 0 0.05 0 0 1 -1.55
image_02: 0.0 0.0 -1.0 0.7 1.0 0.0 0.0 -0.3 0.0 -1.0 0.0 -1.5
image_03: 0.0 0.0 1.0 0.7 -1.0 0.0 0.0 0.4 0.0 -1.0 0.0 -1.5
"""
MEI = f"%YAML:1.0\n---\n{TEXTS['image_02.yaml']}"  # with the header of OpenCV's dialect
FISHEYE = f"%YAML:1.0\n\n# Camera Parameters\n{TEXTS['fisheye.yaml']}"
MULTICOL = {f"InteriorOrientationFisheye{index}.yaml": FISHEYE for index in (0, 1)} | {
    "MultiCamSys_Calibration.yaml": sample("system.yaml")
}
VINS = {
    "cam0_mei.yaml": TEXTS["image_02.yaml"],
    "cam1_mei.yaml": sample("image_02.yaml", camera_name="camera"),
    "estimator.yaml": {
        "num_of_cam": 2,
        "cam0_calib": "cam0_mei.yaml",
        "cam1_calib": "cam1_mei.yaml",
        "body_T_cam0": flat(np.eye(4)),
        "body_T_cam1": flat(RIGHT_OF_FIRST),
    },
}
MRCAL, XMP = TEXTS["front.cameramodel"], TEXTS["image001.xmp"]
STEREO = sample("stereo.yaml")
HALVES = {
    "intrinsics.yml": {key: STEREO[key] for key in ("M1", "D1", "M2", "D2")},
    "extrinsics.yml": {"R": STEREO["R"], "T": STEREO["T"], "R1": flat(QUARTER_TURN)},
}


class Folder:
    """Files that are a rig together, and where its cameras stand."""

    def __init__(
        self, files: Files, names: str, looking: str, positions: Any, paths: str = ".", **given: Any
    ) -> None:
        self.files, self.names, self.looking = files, names.split(), looking.split()
        self.positions, self.paths, self.given = positions, paths.split(), given


FOLDERS = {
    "ocamcalib": Folder(
        OCAM | {"poses.txt": POSES_CM}, "cam1 cam2 cam3 cam4", "ahead right back left",
        [[0, 0, 0], [0.2, 0, -0.2], [0, 0, -0.4], [-0.2, 0, -0.2]], ". poses.txt", translation_unit="cm",
    ),
    "ocamcalib in its unit": Folder(
        {"ocam1.txt": TEXTS["lens.txt"], "poses.txt": "# translation_unit: cm\n0 0 0 1 2 3"}, "cam1", "ahead",
        [[0.01, 0.02, 0.03]],
    ),
    "ocamcalib by numbers": Folder(
        {f"ocam{number}.txt": TEXTS["lens.txt"] for number in range(1, 12)}
        | {"poses.txt": "".join(f"0 0 0 {number} 0 0\n" for number in range(1, 12))},
        " ".join(f"cam{number}" for number in range(1, 12)), "ahead " * 11,
        [[number / 100, 0, 0] for number in range(1, 12)], translation_unit="cm",
    ),
    "euroc": Folder(
        {"cam2/sensor.yaml": sample("sensor.yaml", T_BS=flat(np.eye(4))), "cam10/sensor.yaml": TEXTS["sensor.yaml"]},
        "cam2 cam10", "ahead right", [[0, 0, 0], [0.1, 0, 0.02]],
    ),
    "multicol": Folder(
        MULTICOL, "cam1 cam2", "ahead right", [[0, 0, 0.1], [0.1, 0, 0]], ". MultiCamSys_Calibration.yaml"
    ),
    "vins": Folder(VINS, "cam0 cam1", "ahead right", [[0, 0, 0], [0.11, 0, 0]], "estimator.yaml"),
    "mrcal": Folder(
        {"right.cameramodel": MRCAL,
         "front.cameramodel": MRCAL.replace("-1.5707963267948966", "0").replace("-0.11", "0")},
        "front right", "ahead right", [[0, 0, 0], [0.11, 0, 0]],
    ),
    "opencv, two files": Folder(
        HALVES, "cam1 cam2", "ahead right", [[0, 0, 0], [0.1, 0, 0]], ". extrinsics.yml intrinsics.yml",
        translation_unit="mm", image_size=(240, 320),
    ),
    "kalibr": Folder(
        {"camchain.yaml": kalibr("ds none", "eucm none", "omni none")}, "cam0 cam1 cam2", "ahead right back",
        [[0, 0, 0], [0.1, 0, 0], [0.1, 0, -0.1]],
    ),
    "kalibr by numbers": Folder(
        {"chain.yaml": dict(sorted(kalibr(*["ds none"] * 11).items()))},  # cam0, cam1, cam10, cam2, ...
        " ".join(f"cam{index}" for index in range(11)),
        " ".join(("ahead", "right", "back", "left")[index % 4] for index in range(11)),
        [((0, 0, 0), (0.1, 0, 0), (0.1, 0, -0.1), (0, 0, -0.1))[index % 4] for index in range(11)], "chain.yaml",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FOLDERS)
def test_files_of_a_folder_are_a_rig(tmp_path: Path, name: str) -> None:
    folder = FOLDERS[name]
    write(tmp_path, folder.files)
    for path in folder.paths:
        rig = read_rig(tmp_path / path, dtype=torch.float64, **folder.given)
        assert rig.names == folder.names
        assert_stand(rig, folder.looking, folder.positions, 1e-6)


def test_the_stereo_sets_have_a_field_of_view_and_a_plausible_size(tmp_path: Path) -> None:
    write(tmp_path, OCAM | {"poses.txt": POSES_CM})
    with pytest.warns(UserWarning, match=r"poses.txt.*20 m from their centre.*translation_unit"):
        rig = read_rig(tmp_path, translation_unit="m")
    torch.testing.assert_close(rig.max_angles, torch.full((4,), math.radians(110)))


def test_kitti_360_has_the_axes_of_a_vehicle(tmp_path: Path) -> None:
    """x forward, y right, z down: camera 2 looks left, camera 3 right."""
    write(tmp_path, {"image_02.yaml": MEI, "image_03.yaml": MEI, "calib_cam_to_pose.txt": KITTI360})
    for path in (tmp_path, tmp_path / "calib_cam_to_pose.txt"):
        rig = read_rig(path)
        assert rig.names == ["image_02", "image_03"]
        torch.testing.assert_close(rig.axes, torch.tensor([[-1.0, 0, 0], [1, 0, 0]]))
        torch.testing.assert_close(rig.positions[:, 1], torch.tensor([-0.3, 0.4]))


def test_woodscape_has_the_axes_of_a_vehicle(tmp_path: Path) -> None:
    """The sample's front camera looks along the vehicle's x, and its down is the vehicle's -z."""
    names = ("FV", "RV", "MVL", "MVR")
    write(tmp_path, {f"00001_{name}.json": sample("FV.json", name=name) for name in names})
    rig = read_rig(tmp_path, dtype=torch.float64)
    assert rig.names == ["FV", "MVL", "MVR", "RV"]
    assert rig.positions[0].tolist() == [3.75, 0.0, 0.66]
    expected = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]).double()  # columns: right, down, forward
    torch.testing.assert_close(rig.world_from_camera[0, :3, :3], expected)


def test_realitycapture_takes_the_world_to_the_camera(tmp_path: Path) -> None:
    write(tmp_path, {"a.xmp": XMP, "b.xmp": XMP.replace(">1.5 ", ">1.75 ")})
    rig = read_rig(tmp_path, image_size=(480, 640), dtype=torch.float64)
    assert rig.names == ["a", "b"]
    assert rig.positions[1].tolist() == [1.75, -0.25, 0.75]
    rows = torch.tensor([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]).double()
    torch.testing.assert_close(rig.world_from_camera[0, :3, :3], rows.T)


def test_blender_has_axes_of_its_own_and_panoramas_with_limits(tmp_path: Path) -> None:
    rig = read_rig(dump(tmp_path / "blender.json", TEXTS["blender.json"]), dtype=torch.float64)
    plain, whole = rig.cameras["plain"], rig.cameras["equirectangular"]
    assert whole.edges == "sphere"
    limits = {"latitude_min": -0.2, "longitude_max": 1.0}
    part = sample("blender.json")["cameras"]["equirectangular"] | limits
    camera = read_camera(dump(tmp_path / "part.json", {"cameras": {"part": part}}))
    assert camera.latitudes == pytest.approx((-0.2, math.pi / 2))
    assert camera.longitudes == pytest.approx((-math.pi, 1.0))
    assert plain.focal_length.tolist() == pytest.approx([30 / 36 * 640] * 2)
    assert rig.positions[0].tolist() == [0.5, 0.2, 1.6]
    torch.testing.assert_close(rig.axes[0], torch.tensor([0.0, 1.0, 0.0]).double())
    fisheyes = [
        angle for name, angle in zip(rig.names, rig.max_angles.tolist(), strict=True) if "fisheye" in name
    ]
    assert len(fisheyes) == 3
    assert all(1.3 < angle < 1.4 + 1e-12 for angle in fisheyes)


@pytest.mark.parametrize(
    ("fit", "focal_length", "side"),
    [("AUTO", 30 / 36 * 900, 900), ("HORIZONTAL", 30 / 36 * 600, 600), ("VERTICAL", 30 / 24 * 900, 900)],
)
def test_blenders_sensor_fits_the_side_that_it_says(
    tmp_path: Path, fit: str, focal_length: float, side: int
) -> None:
    """A portrait picture: the sensor's width is its height, or the sensor's height is; the shift moves the picture."""
    size = {"resolution_x": 600, "resolution_y": 900, "resolution_percentage": 100}
    lens = sample("blender.json")["cameras"]["plain"] | size | {"sensor_fit": fit, "shift_y": 0.1}
    camera = read_camera(dump(tmp_path / "blender.json", {"cameras": {"plain": lens}}))
    assert isinstance(camera, PinholeCamera)
    assert camera.focal_length.tolist() == pytest.approx([focal_length] * 2)
    assert camera.principal_point.tolist() == pytest.approx([299.5, 449.5 + 0.1 * side])


# Transforms that files state in several ways --------------------------------------------------------------------------


def imu_poses() -> Tensor:
    """Of three cameras in a body, z up, 90° apart; a turn of the wrong kind does not fit them."""
    turns = Rotation.from_euler("ZX", [[-45, -90], [45, -90], [135, -90]], degrees=True)
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    poses[:, :3, :3] = torch.from_numpy(turns.as_matrix())
    poses[:, :3, 3] = 0.1 * poses[:, :3, 2]
    return poses


@pytest.mark.parametrize("key", ["T_imu_cam", "T_cam_imu"])
@pytest.mark.parametrize("count", [1, 3])
def test_kalibr_and_openvins_place_cameras_in_the_imu_frame(tmp_path: Path, key: str, count: int) -> None:
    """One writes camera to IMU, the other IMU to camera; with the chain, or as in files that only have the IMU's."""
    poses = imu_poses()[:count]
    stated = poses if key == "T_imu_cam" else torch.linalg.inv(poses)
    chain = {f"cam{k}": KALIBR["ds none"] | {key: pose.tolist()} for k, pose in enumerate(stated)}
    rig = read_rig(dump(tmp_path / "camchain.yaml", chain), dtype=torch.float64)
    torch.testing.assert_close(rig.world_from_camera, poses)
    for k in range(1, count):
        chain[f"cam{k}"]["T_cn_cnm1"] = (torch.linalg.inv(poses[k]) @ poses[k - 1]).tolist()
    rig = read_rig(dump(tmp_path / "camchain.yaml", chain), dtype=torch.float64)
    torch.testing.assert_close(rig.world_from_camera, poses)
    if count > 1:
        other = {"T_imu_cam": "T_cam_imu", "T_cam_imu": "T_imu_cam"}[key]
        for values in chain.values():
            values[other] = values.pop(key)
        with pytest.raises(FileFormatError, match=r"cam1: T_cn_cnm1 and .* contradict each other"):
            read_rig(dump(tmp_path / "camchain.yaml", chain))


def test_written_chain_and_imu_transforms_say_the_same(tmp_path: Path) -> None:
    turns = torch.tensor([[0.1, 0.2, -0.3], [0.0, 2.0, 0.5], [-3.0, 0.4, 0.1]], dtype=torch.float64)
    poses = transform_from_axis_angle(turns, 0.1 * turns.flip(0))
    rig = CameraRig([PinholeCamera([100.0, 100.0], [49.5, 49.5], (100, 100))] * 3, poses)
    save_rig(rig, tmp_path / "camchain.yaml", format="kalibr")
    text = (tmp_path / "camchain.yaml").read_text().replace("T_cam_imu", "comment")
    chained = read_rig(dump(tmp_path / "chain.yaml", text), dtype=torch.float64)
    moved = rig.world_from_camera[0] @ chained.world_from_camera  # from the frame of cam0
    torch.testing.assert_close(moved, rig.world_from_camera, rtol=0, atol=1e-14)


def test_orbslams_body_becomes_the_world_and_its_older_spelling_is_read(tmp_path: Path) -> None:
    body = np.diag([-1.0, -1.0, 1.0, 1.0])
    body[:3, 3] = 0.0, 0.02, 0.1
    content = sample("settings.yaml", **{"IMU.T_b_c1": flat(body)})
    rig = read_rig(dump(tmp_path / "stereo.yaml", content), dtype=torch.float64)
    expected = np.stack((body, body @ np.array(RIGHT_OF_FIRST)))
    np.testing.assert_allclose(rig.world_from_camera.numpy(), expected, atol=1e-12)
    older = {key.replace("Camera1.", "Camera."): value for key, value in content.items()}
    older |= {"Tlr": flat(RIGHT_OF_FIRST[:3]), "Tbc": older.pop("IMU.T_b_c1")}
    del older["Stereo.T_c1_c2"]
    again = read_rig(dump(tmp_path / "old.yaml", older), dtype=torch.float64)
    assert all(again.cameras[name].equals(camera) for name, camera in rig.cameras.items())
    assert torch.equal(again.world_from_camera, rig.world_from_camera)


def test_omnidir_stereo_sample_with_rotation_vector(tmp_path: Path) -> None:
    lens = {
        "camera_matrix": [[400.0, 0, 320.5], [0, 401.0, 240.25], [0, 0, 1]],
        "distortion_coefficients": [0.1, 0.0, 0.0, 0.0],
    }
    values = {f"{key}_{index}": value for index in (1, 2) for key, value in {**lens, "xi": 1.2}.items()}
    rvec = cv2.Rodrigues(np.array(QUARTER_TURN))[0].ravel().tolist()
    path = dump(tmp_path / "stereo.yaml", storage(**values, rvec=rvec, tvec=[0.0, 0.0, -0.1]))
    rig = read_rig(path, translation_unit="m", image_size=(480, 640), dtype=torch.float64)
    assert {camera.model for camera in rig.cameras.values()} == {"unified"}
    assert_stand(rig, ["ahead", "right"], [[0, 0, 0], [0.1, 0, 0]])


# Names, masks, and cameras that are marked ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (["./train/rig.000", "./train/rig.001"], ["train/rig.000", "train/rig.001"]),
        ([r".\images\a.png", r".\images\b.PNG"], ["images/a", "images/b"]),
        (["c.front.jpg", "c.back.jpg"], ["c.front", "c.back"]),
        (["a.1.insp", "a.2.HEIF"], ["a.1", "a.2"]),
    ],
)
def test_names_of_views_are_kept_whole(tmp_path: Path, files: list[str], names: list[str]) -> None:
    content = sample("transforms.json")
    for frame, file in zip(content["frames"], files, strict=True):
        frame["file_path"] = file
    assert read_rig(dump(tmp_path / "transforms.json", content)).names == names


def test_several_cameras_in_one_file(tmp_path: Path) -> None:
    path = dump(
        tmp_path / "fisheyes.yaml", {name: sample("image_02.yaml") for name in ("image_02", "image_03")}
    )
    assert list(read_cameras(path)) == ["image_02", "image_03"]
    assert read_camera(path, "image_03").equals(read_camera(path, "image_02"))


def test_masks_are_black_or_white_where_pixels_are_usable_and_bound_the_view(tmp_path: Path) -> None:
    pixels = np.zeros((240, 320), np.uint8)
    pixels[:, :100] = 255
    cv2.imwrite(str(tmp_path / "mask2.png"), pixels)  # of OmniMVS, white where a pixel must not be used
    rig = read_rig(dump(tmp_path / "config.yaml", TEXTS["config.yaml"]))
    assert rig.names == ["cam1", "cam2"]
    assert list(rig.masks) == ["cam2"]
    assert torch.equal(rig.masks["cam2"], torch.from_numpy(pixels == 0))
    torch.testing.assert_close(rig.max_angles, torch.full((2,), math.radians(95)))
    cv2.imwrite(str(tmp_path / "mask1.png"), np.zeros((24, 32), np.uint8))
    with pytest.raises(SphericalVisionError, match=r"mask1.png: expected 320 x 240 pixels .* got 32 x 24"):
        read_rig(tmp_path)
    mask = torch.zeros(512, 512, dtype=torch.bool)
    mask[134:376, 150:350] = True
    (tmp_path / "basalt" / "cam0").mkdir(parents=True)
    write_mask(tmp_path / "basalt" / "cam0" / "mask.png", mask)
    rig = read_rig(dump(tmp_path / "basalt" / "calibration.json", basalt("ds", "kb4")), dtype=torch.float64)
    assert rig.names == ["cam0", "cam1"]
    assert torch.equal(rig.masks["cam0"], mask)
    corners = torch.cartesian_prod(torch.tensor([150.0, 349.0]), torch.tensor([134.0, 375.0])).double()
    directions = rig.cameras["cam0"].unproject(corners).directions
    widest = torch.atan2(directions[:, :2].norm(dim=-1), directions[:, 2]).max()
    torch.testing.assert_close(rig.max_angles[0], widest)
    assert read_rig(tmp_path / "basalt", max_angle=1.0).max_angles.tolist() == [1.0, 1.0]


def test_bad_frames_and_disabled_cameras_are_left_out_with_a_warning(tmp_path: Path) -> None:
    content = sample("transforms.json")
    names = read_rig(dump(tmp_path / "all.json", content)).names
    content["frames"][0]["is_bad"], content["frames"][1]["is_bad"] = True, False
    content["frames"][1]["mask_path"] = "masks/b.png"
    with (
        pytest.warns(UserWarning, match="1 left out.*is_bad"),
        pytest.warns(UserWarning, match="left out, masks .*masks/b.png"),
    ):
        assert read_rig(dump(tmp_path / "some.json", content)).names == names[1:]
    chunk = TEXTS["chunk.xml"]
    off = 'label="DSC_1" enabled="false"><reference x="1" y="2"/>'
    path = dump(tmp_path / "cameras.xml", chunk.replace('label="DSC_1">', off))
    with pytest.warns(UserWarning, match="disabled: DSC_1"):
        assert read_rig(path).names == ["DSC_2"]
    dump(path, chunk.replace('label="DSC_1"', 'label="DSC_1" enabled="true"'))
    assert read_rig(path).names == ["DSC_1", "DSC_2"]


SENSOR = '<sensor id="3" type="TYPE"><resolution width="1920" height="960"/><property value="0"/></sensor></sensors>'
PHOTO = '<camera id="3" sensor_id="3" label="pano"><transform>1 0 0 0.5 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera>'
UNUSED = TEXTS["chunk.xml"].replace("</sensors>", SENSOR.replace("TYPE", "frame"))


def test_sensors_of_metashape_without_a_calibration(tmp_path: Path) -> None:
    """A spherical one has nothing to calibrate; one of another kind is of images that were not aligned."""
    whole = TEXTS["chunk.xml"].replace("</sensors>", SENSOR.replace("TYPE", "spherical"))
    rig = read_rig(dump(tmp_path / "sphere.xml", whole.replace("</cameras>", f"{PHOTO}</cameras>")))
    assert rig.cameras["pano"].equals(EquirectangularCamera((960, 1920)))
    assert read_rig(dump(tmp_path / "unused.xml", UNUSED)).names == ["DSC_1", "DSC_2"]
    assert read_cameras(dump(tmp_path / "chunk.xml", TEXTS["chunk.xml"]))["cam2"].equals(
        EquirectangularCamera((320, 640))
    )


def test_slave_sensors_of_metashape_have_their_masters_pose_and_their_own(tmp_path: Path) -> None:
    rig = read_rig(dump(tmp_path / "cameras.xml", TEXTS["dual.xml"]), dtype=torch.float64)
    assert rig.names == ["front", "back"]
    assert rig.axes.tolist() == [[0, 0, 1], [0, 0, -1]]
    assert float(rig.positions[1, 2] - rig.positions[0, 2]) == pytest.approx(-0.05)
