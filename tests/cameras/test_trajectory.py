# SPDX-License-Identifier: Apache-2.0
"""Poses of a camera that moves: every format tells the same, windows are rigs, images find their poses."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import pytest
import torch

from sphericalvision.cameras import CameraRig, FisheyeCamera, Trajectory, read_trajectory, save_rig
from sphericalvision.cameras.calibration.poses import quaternion_from_rotation
from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.geometry import transform_from_axis_angle

NUMBER = 12
CAMERA = FisheyeCamera.from_field_of_view((32, 40), 3.0)


def way() -> torch.Tensor:
    """Poses along a bend, 10 cm apart, each turned a little further."""
    generator = torch.Generator().manual_seed(2)
    turns = torch.rand(NUMBER, 3, generator=generator, dtype=torch.float64) - 0.5
    steps = torch.arange(NUMBER, dtype=torch.float64)
    places = torch.stack((0.01 * steps**2, 0 * steps, 0.1 * steps), -1)
    return transform_from_axis_angle(turns, places)


def tum(poses: torch.Tensor) -> str:
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for number, pose in enumerate(poses):
        w, *xyz = quaternion_from_rotation(pose[:3, :3])
        values = [*pose[:3, 3].tolist(), *xyz, w]
        lines.append(f"{1305031102 + number / 10:.6f} " + " ".join(f"{value:.12f}" for value in values))
    return "\n".join(lines)


def table(poses: torch.Tensor, header: str, order: str, separator: str = ",", more: str = "") -> str:
    """Nanoseconds, and the columns in an order, under a header."""
    lines = [header]
    for number, pose in enumerate(poses):
        w, *xyz = quaternion_from_rotation(pose[:3, :3])
        names = ("x", "y", "z", "qw", "qx", "qy", "qz")
        values = dict(zip(names, [*pose[:3, 3].tolist(), w, *xyz], strict=True))
        time = str((1305031102000 + 100 * number) * 10**6)
        lines.append(separator.join([time, *(f"{values[name]:.12f}" for name in order.split())]) + more)
    return "\n".join(lines)


W_FIRST, W_LAST = "x y z qw qx qy qz", "x y z qx qy qz qw"
NANOSECONDS = ["1305031102000000000", "1305031102100000000"]
EUROC = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_x [m]"
TABLES = {
    "euroc": table(way(), EUROC, W_FIRST, ",", ",0.5"),
    "tum-vi": table(way(), "# timestamp[ns],tx,ty,tz,qw,qx,qy,qz", W_FIRST),
    "words, w first": table(way(), "# timestamp tx ty tz qw qx qy qz", W_FIRST, " "),
    "no comment": table(way(), "time,x,y,z,qx,qy,qz,qw", W_LAST),
    "turn before place": table(way(), "# t qx qy qz qw x y z", "qx qy qz qw x y z", " "),
    "prose": table(way(), "# ground truth trajectory by x, y and z", W_LAST, " "),
    "another name of time": table(way(), "# ts tx ty tz qw qx qy qz", W_FIRST, " "),
    "semicolons": table(way(), "time;x;y;z;qx;qy;qz;qw", W_LAST, ";"),
    "aria": table(
        way(),
        "utc_timestamp_ns," + ",".join(f"{c}_world_device" for c in f"t{W_LAST}".split()) + ",graph_uid",
        W_LAST,
        more=",a-b",
    ),
    "tabs": table(way(), "time\tx\ty\tz\tqx\tqy\tqz\tqw", W_LAST, "\t"),
    "quoted": table(way(), '"time","tx","ty","tz","qx","qy","qz","qw"', W_LAST),
    "an end of lines of Windows": table(way(), EUROC, W_FIRST, ",", ",0.5\r"),
}


TWO_COLUMNS = {
    header: re.sub(
        r"\n(\d{10})", r"\n0,\1,", table(way(), f"# count, {header}, x, y, z, qx, qy, qz, qw", W_LAST)
    )
    for header in (
        "sec, nsec",
        "secs, nsecs",
        "sec, nanosec",
        "header.stamp.sec, header.stamp.nanosec",
        "timestamp_s, timestamp_ns",
        "seconds, nanoseconds",
    )
}


COMMAS = [
    tum(way()),
    table(way(), "time;x;y;z;qx;qy;qz;qw", W_LAST, ";"),
    table(way(), "time\tx\ty\tz\tqx\tqy\tqz\tqw", W_LAST, "\t"),
]


def decimal_commas(text: str) -> str:
    return text.replace(".", ",")


def kitti(poses: torch.Tensor, rows: int, numbered: bool) -> str:
    return "\n".join(
        (f"{7 * number} " if numbered else "")
        + " ".join(f"{value:.12f}" for value in pose[:rows].flatten().tolist())
        for number, pose in enumerate(poses)
    )


@pytest.mark.parametrize(
    ("text", "names"),
    [
        (tum(way()), ["1305031102.000000", "1305031102.100000"]),
        *((text, NANOSECONDS) for text in TABLES.values()),
        *((text, ["1305031102.000000000", "1305031102.100000000"]) for text in TWO_COLUMNS.values()),
        (kitti(way(), 3, False), ["0", "1"]),
        (kitti(way(), 4, False), ["0", "1"]),
        (kitti(way(), 3, True), ["0", "7"]),
        (kitti(way(), 4, True), ["0", "7"]),
        (tum(way()) + "\n" + tum(way()).splitlines()[0], ["1305031102.000000", "1305031102.100000"]),
    ],
    ids=[
        "tum",
        *TABLES,
        *TWO_COLUMNS,
        "kitti",
        "kitti, 4 rows",
        "kitti-360",
        "kitti-360, 4 rows",
        "two headers",
    ],
)
def test_texts_tell_poses_and_names(text: str, names: list[str], tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text(text + "\n")
    read = read_trajectory(tmp_path / "poses.txt")
    assert list(read.names[:2]) == names
    torch.testing.assert_close(read.world_from_camera, way(), atol=1e-9, rtol=0)


@pytest.mark.parametrize("file", ["", "images.txt", "cameras.bin"])
def test_images_of_colmap_come_in_the_order_of_their_names(file: str, tmp_path: Path) -> None:
    names = [f"frame{number}" for number in (11, *range(1, 11), 0)]  # 10 comes after 9
    names[9] = "frame009"
    save_rig(CameraRig(dict.fromkeys(["1", "01"], CAMERA), way()[:2]), tmp_path / "other", "colmap")
    assert sorted(read_trajectory(tmp_path / "other").names) == ["01", "1"]  # two images, which are no times
    save_rig(CameraRig(dict.fromkeys(names, CAMERA), way()), tmp_path / "sparse" / file, "colmap")
    read = read_trajectory(tmp_path / "sparse")
    assert list(read.names) == [f"frame{number}" for number in (*range(9), "009", 10, 11)]
    torch.testing.assert_close(read.world_from_camera[11], way()[0], atol=1e-6, rtol=0)
    if file != "cameras.bin":
        # COLMAP's, no header of a table
        comment = "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
        text = (tmp_path / "sparse" / "images.txt").read_text().split("\n", 1)[1]
        (tmp_path / "renamed.txt").write_text(comment + text)
        assert read_trajectory(tmp_path / "renamed.txt").names == read.names
    other = "images.txt" if file.endswith("bin") else "cameras.bin"
    save_rig(CameraRig(dict.fromkeys(names, CAMERA), way()), tmp_path / "sparse" / other, "colmap")
    assert read_trajectory(tmp_path / "sparse").names == read.names
    save_rig(CameraRig(dict.fromkeys(names, CAMERA), way().flip(0)), tmp_path / "sparse" / other, "colmap")
    with pytest.raises(FileFormatError, match=r"images\.bin and images\.txt hold different poses"):
        read_trajectory(tmp_path / "sparse")


HEADER, POSE = "# time tx ty tz qx qy qz qw\n", "{} 0 0 0 0 0 0 1\n"
SEVERAL = "t x y z qw qx qy qz {}\n0 0 0 0 1 0 0 0 0\n1 0 0 0 1 0 0 0 0\n2 0 0 0 1 0 0 0 1"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no pose in it"),
        ("1 2 3", "line 1: 3 values"),
        ("0.1 0 0 0 0 0 0 1\n0.2 0 0 0 0 0 0 0.5", "line 2: expected a quaternion of length 1"),
        ("0.1 0 0 0 0 0 0 1\n0.2 0 0 0 0 0 0", "line 2: expected 8 numbers, got 7"),
        ("0.1 0 0 0 0 0 0 1\n0.1 1 0 0 0 0 0 1", r"two poses are called 0\.1"),
        ("0.1 0 0 0 0 0 0 1\n0.100 1 0 0 0 0 0 1", r"two poses are called 0\.100"),
        ("0.1 0 0 0 0 0 0 1\n0.2 1e30 0 0 0 0 0 1", r"more than 1e\+08 m from the origin; expected metres"),
        ("0.1 0 0 0 0 0 0 1\n0.2 nan 0 0 0 0 0 1", "line 2: expected finite numbers"),
        ("t x y z qw qx qy qz scale\n0 0 0 0 1 0 0 0 1.1", "expected 1 in the column scale"),
        ("-1 0 0 0 0 1 0 0 0 0 1 0", r"line 1: expected a rotation.*got a mirror \(determinant -1\)"),
        *((decimal_commas(text), "line 2: decimals have commas") for text in COMMAS),
        ("1 0 0 0 0 2 0 0 0 0 1 0", "line 1: expected a rotation"),
        (HEADER + POSE.format(0) + HEADER.replace("qx qy qz qw", "qw qx qy qz") + POSE.format(1), "line 3"),
        (table(way(), "# no names", W_FIRST), "8 columns"),  # with commas
        (table(way(), "# time x y z qw qx qy qz extra", W_FIRST, " "), "the header names 9 columns"),
        (table(way(), EUROC.replace("[m]", "[mm]"), W_FIRST), "line 1: expected positions in metres"),
        (
            "# sec nsec x y z qx qy qz qw\n0.5 7 0 0 0 0 0 0 1",
            "line 2: expected whole seconds and nanoseconds .* got 0.5 and 7",
        ),
        *((SEVERAL.format(key), f"2 values of '{key}'") for key in ("camera_id", "tracking_lost", "session")),
    ],
)
def test_broken_files_are_told_by_their_line(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_trajectory(tmp_path / "poses.txt")


def test_the_other_order_of_quaternions_is_told(tmp_path: Path) -> None:
    """A way that begins with w first and no turn: nothing else writes half a turn about x."""
    lines = [f"{number / 10:.1f} 0 0 {number} 1 0 0 0" for number in range(4)]
    (tmp_path / "way.txt").write_text("\n".join(lines))
    with pytest.warns(
        UserWarning, match="line 1: 1 0 0 0 is half a turn about x.*# time tx ty tz qw qx qy qz"
    ):
        half_turns = read_trajectory(tmp_path / "way.txt").world_from_camera
    assert (half_turns[:, 1, 1] == -1).all()
    (tmp_path / "way.txt").write_text("\n".join(["# time tx ty tz qw qx qy qz", *lines]))
    assert torch.equal(
        read_trajectory(tmp_path / "way.txt").world_from_camera[:, 1, 1], torch.ones(4).double()
    )


@pytest.mark.parametrize(
    ("comment", "is_told"),
    [
        ("positions in millimetres", True),
        ("units: cm", True),
        ("mm", True),
        ("world to camera", True),
        ("T_cam_world of each image", True),
        ("quaternion order: qw qx qy qz", True),
        ("time lat lon alt qx qy qz qw", True),
        ("positions in m, of a rig with 60 mm lenses", False),
        ("camera to world, metres", False),
        ("time tx ty tz qx qy qz qw", False),
        ("written in minutes", False),
        ("IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", False),
    ],
)
def test_a_comment_against_the_convention_is_asked_about(tmp_path: Path, comment: str, is_told: bool) -> None:
    path = tmp_path / "way.txt"
    path.write_text(f"# {comment}\n0.0 0 0 0 0 0 0 1\n0.1 0 0 5 0 0 0 1\n")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read_trajectory(path)
    assert [f"{path}, line 1" in str(warning.message) for warning in caught] == [True] * is_told


def test_windows_pass_over_what_is_too_near() -> None:
    poses = torch.eye(4).repeat(6, 1, 1)
    poses[:, 0, 3] = torch.tensor([0.0, 0.1, 0.1, 0.1, 0.25, 0.4])  # it stands still for a while
    trajectory = Trajectory(list("abcdef"), poses)
    assert trajectory.windows(2) == [[0, 1], [1, 2], [2, 3], [3, 4], [4, 5]]
    assert trajectory.windows(3, spacing=0.1) == [[0, 1, 4], [1, 4, 5]]


@pytest.mark.parametrize(("metres", "is_told"), [(0.1, False), (100.0, True), (1e-5, True)])
def test_a_window_of_a_size_that_no_rig_has_is_asked_about(metres: float, is_told: bool) -> None:
    poses = torch.eye(4).repeat(3, 1, 1)
    poses[:, 2, 3] = metres * torch.arange(3)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        Trajectory(["a", "b", "c"], poses).rig(CAMERA, [0, 1, 2])
    assert [str(w.message).startswith("poses: images of a window") for w in caught] == [True] * is_told


def test_a_window_is_a_rig_with_the_poses_of_its_images() -> None:
    trajectory = Trajectory([str(k) for k in range(NUMBER)], way())
    mask = torch.ones(32, 40, dtype=torch.bool)
    rig = trajectory.rig(CAMERA, [3, 5, 7], mask)
    assert rig.names == ["3", "5", "7"]
    assert list(rig.masks) == rig.names
    torch.testing.assert_close(rig.world_from_camera, way()[[3, 5, 7]].float())
    torch.testing.assert_close(rig.center, rig.positions.mean(0))


def test_a_window_of_a_rig_has_all_its_cameras_at_all_poses_around_the_one_in_the_middle() -> None:
    trajectory = Trajectory([f"{k / 10:.1f}" for k in range(NUMBER)], way())
    poses = transform_from_axis_angle(torch.tensor([[0.0, 0.3, 0.0], [0.1, -2.0, 0.0]]), torch.eye(3)[:2])
    mask = torch.arange(32 * 40).view(32, 40) > 99
    still = CameraRig({"left": CAMERA, "right": CAMERA}, poses, {"right": mask})
    rig = trajectory.rig(still, [3, 5, 9])
    assert rig.names == ["left@0.3", "right@0.3", "left@0.5", "right@0.5", "left@0.9", "right@0.9"]
    for number, time in ((3, "0.3"), (5, "0.5"), (9, "0.9")):
        at = way()[number] @ poses.double()
        found = rig.subset([f"left@{time}", f"right@{time}"]).world_from_camera
        torch.testing.assert_close(found, at.float())
    assert list(rig.masks) == ["right@0.3", "right@0.5", "right@0.9"]
    assert all(torch.equal(found, mask) for found in rig.masks.values())
    center = (way()[5] @ torch.tensor([0.5, 0.5, 0, 1], dtype=torch.float64))[:3].float()
    torch.testing.assert_close(rig.center, center)
    origin = torch.tensor([2.0, 0.0, 0.0]).double()
    around_left = CameraRig(still.cameras, poses, None, ["left"], origin)
    left = (way()[5] @ torch.tensor([3.0, 0, 0, 1], dtype=torch.float64))[:3].float()
    torch.testing.assert_close(trajectory.rig(around_left, [3, 5, 9]).center, left)
    lone = trajectory.rig(still.subset(["right"]), [3, 5])  # a camera beside the rig's own frame
    assert lone.names == ["0.3", "0.5"]
    torch.testing.assert_close(lone.world_from_camera, (way()[[3, 5]] @ poses[1].double()).float())
    with pytest.raises(ArgumentError, match="mask: a rig has masks of its own"):
        trajectory.rig(still, [3], mask)


@pytest.mark.parametrize(("up", "axis"), [("-y", [0, -1, 0]), ("y", [0, 1, 0]), ("z", [0, 0, 1])])
def test_up_is_minus_y_once_turned(up: str, axis: list[float]) -> None:
    before = Trajectory([str(k) for k in range(NUMBER)], way())
    after = before.turned(up)
    turn = after.world_from_camera @ before.world_from_camera.inverse()
    torch.testing.assert_close(turn, turn[:1].expand_as(turn), atol=1e-9, rtol=0)  # one for all
    upwards = turn[0, :3, :3] @ torch.tensor(axis, dtype=torch.float64)
    torch.testing.assert_close(upwards, torch.tensor([0.0, -1, 0], dtype=torch.float64), atol=1e-9, rtol=0)


def test_up_can_be_what_the_camera_held_up() -> None:
    tilted = transform_from_axis_angle(torch.tensor([0.7, 0.0, 0.4]), torch.zeros(3)) @ way().float()
    after = Trajectory([str(k) for k in range(NUMBER)], tilted).turned("camera")
    mean = after.world_from_camera[:, :3, 1].mean(0)
    assert mean[[0, 2]].norm() < 1e-5 * mean[1]  # down is +y


@pytest.mark.parametrize(
    ("names", "images", "times", "found"),
    [
        (["a1", "a2", "a3"], ["a3", "b", "a1"], None, {"a3": 2, "a1": 0}),  # names
        (["10.00", "10.05", "10.10"], ["10.049", "10.08", "10.5"], None, {"10.049": 1, "10.08": 2}),
        (["10.00", "10.05"], ["10051000000", "10000000000000"], None, {}),  # neither seconds nor nanoseconds
        (["1403636579.76", "1403636579.81"], ["1403636579813555584"], None, {"1403636579813555584": 1}),
        (["0", "1", "2", "3"], ["000001", "000003"], None, {"000001": 1, "000003": 3}),  # rows
        (["5.0", "6.0"], ["000005", "000006"], None, {"000005": 0, "000006": 1}),  # numbers are no times
        (["0.0", "0.1", "0.2", "0.3"], ["x", "y"], [0.1, 0.3], {"x": 1, "y": 3}),  # of a video
        (["0.0", "1.0", "2.0"], ["img_0", "img_1", "img_2"], None, {}),  # counts after a word
        (["0.0", "2.0"], ["img_1", "img_2"], None, {}),  # counted from 1
        (["1.00", "1.05"], ["1.010", "1.001", "1.05"], None, {"1.001": 0, "1.05": 1}),  # one image of a pose
    ],
)
def test_images_find_their_poses(
    names: list[str], images: list[str], times: list[float] | None, found: dict[str, int]
) -> None:
    poses = torch.eye(4).repeat(len(names), 1, 1)
    poses[:, 0, 3] = torch.arange(len(names))
    trajectory = Trajectory(names, poses)
    if not found:
        found = dict(zip(images, range(len(images)), strict=True))  # as many as poses: in order
    matched = trajectory.of_images(images, times)
    assert dict(zip(matched.names, matched.positions[:, 0].int().tolist(), strict=True)) == found


def test_times_that_never_meet_tell_that_poses_are_of_another_run() -> None:
    poses = Trajectory([f"{1.7e9 + 7200 + k:.2f}" for k in range(NUMBER)], way())
    with pytest.raises(ArgumentError, match="which pose is whose"):
        poses.of_images([f"{1.7e9 + k:.3f}" for k in range(NUMBER)])
    assert len(poses.of_images([f"{k}.5" for k in range(NUMBER)])) == NUMBER  # since the start of a recording


@pytest.mark.parametrize("first", [0, 1, 7])
@pytest.mark.parametrize("number", [NUMBER - 3, NUMBER])
@pytest.mark.parametrize("rows", [True, False], ids=["rows", "stated"])
def test_numbers_belong_together_where_they_state_it(first: int, number: int, rows: bool) -> None:
    """Images are counted from ``first``, poses from 0: by number, by position, or refused, never the next one's."""
    trajectory = Trajectory([str(row) for row in range(NUMBER)], way(), names_are_rows=rows)
    images = [f"{first + k:06d}" for k in range(number)]
    shifted = first + number > NUMBER or (first > 0 and rows)
    if shifted and number < NUMBER:
        with pytest.raises(ArgumentError, match="which pose is whose"):
            trajectory.of_images(images)
        return
    expected = way()[:number] if shifted else way()[first : first + number]
    assert list(trajectory.of_images(images).names) == images
    torch.testing.assert_close(trajectory.of_images(images).world_from_camera, expected)
    if rows:  # of keyframes
        with pytest.raises(ArgumentError, match="which pose is whose"):
            trajectory.of_images([f"{k:06d}" for k in range(NUMBER + 3)])
