# SPDX-License-Identifier: Apache-2.0
"""Prediction on images of a camera or a rig that moves: windows of them are the rigs that their poses say."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from sphericalvision.cameras import (
    CameraRig,
    EquirectangularCamera,
    read_rig,
    read_trajectory,
    ring_rig,
    save_camera,
    save_rig,
)
from sphericalvision.cameras.robot_frame import OPTICAL_FROM_ROS
from sphericalvision.cameras.trajectory import upright_turn
from sphericalvision.capture import Predictor
from sphericalvision.capture.alignment import RigTurns
from sphericalvision.capture.sources.frames import Selection
from sphericalvision.core import ArgumentError
from sphericalvision.io.images import read_image, write_image, write_mask
from sphericalvision.models import SemiGlobalSweep
from sphericalvision.recipes.app import checks
from sphericalvision.recipes.app.captures import PosedCapture
from sphericalvision.recipes.commands.predict import PredictConfig, nearest, predictor_for, warn_if_inverted
from sphericalvision.scenes import make_scene, ray_depth, render_rig
from tests.recipes.tiny import Run, composed, typed

SIZE = (24, 48)
NUMBER = 7


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Seven panoramas on a straight way, the fourth of which was taken where the third was, in a world with z up."""
    generator = torch.Generator().manual_seed(1)
    lines = []
    for number, place in enumerate((0.0, 0.1, 0.2, 0.2, 0.3, 0.4, 0.5)):
        lines.append(f"{number} 0 {place} 0 -0.70710678 0 0 0.70710678")
        write_image(tmp_path / f"walk/{number:03d}.png", torch.rand(3, *SIZE, generator=generator))
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    return tmp_path


TWO = ring_rig(2, radius=0.1, image_size=(48, 48))
"""A fisheye to the front and one to the back, which see next to nothing twice."""
SCENE = make_scene("room", seed=10_100_003)
COARSE = "method=semi_global level=4 num_hypotheses=16 min_depth=0.5"


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """Five frames of such a rig on a bend, called by their times, and poses of the rig for four of them and others."""
    lines = []
    for number in range(6):
        right, forward, half = 0.02 * number**2, 0.15 * number, 0.05 * number
        lines.append(f"{10 + number / 10:.3f} {right} 0 {forward} 0 {np.sin(half)} 0 {np.cos(half)}")
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    trajectory = read_trajectory(tmp_path / "poses.txt")
    images = render_rig(SCENE, trajectory.rig(TWO, range(6)))
    for number in range(5):
        for name in TWO.names:
            image = images[f"{name}@{10 + number / 10:.3f}"]
            write_image(tmp_path / f"drive/{name}/{10.004 + number / 10:.3f}.png", image)
    del lines[0]  # the first frame is left out
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    for name in TWO.names:
        write_mask(tmp_path / f"masks/{name}.png", torch.arange(48).expand(48, 48) > 1)
    save_rig(TWO, tmp_path / "rig.yaml")
    return tmp_path


def of_drive(drive: Path) -> tuple[str, ...]:
    images = f"calibration={drive}/rig.yaml images={drive}/drive poses={drive}/poses.txt"
    return typed(f"{images} output=out outputs=[npz] height=16 device=cpu align=false {COARSE}")


def write_poses(path: Path, names: Sequence[str], poses: torch.Tensor) -> None:
    lines = []
    for name, pose in zip(names, poses, strict=True):
        turn = Rotation.from_matrix(pose[:3, :3].numpy()).as_quat()
        lines.append(" ".join(map(str, (name, *pose[:3, 3].tolist(), *turn))))
    path.write_text("\n".join(lines))


def test_poses_of_a_robots_frame_are_those_of_its_rig(run: Run, drive: Path, tmp_path: Path) -> None:
    """Poses of ``base_link`` in a world whose z is up, and the rig in it: the same depth, points in that world."""
    trajectory = read_trajectory(drive / "poses.txt")
    optical_from_world = upright_turn("z", torch.eye(4)[None]).double()
    base_from_rig = torch.linalg.inv(OPTICAL_FROM_ROS).double()
    base_from_rig[:3, 3] = torch.tensor([0.3, 0.0, 1.2])
    np.savetxt(tmp_path / "base.txt", base_from_rig[:3])
    rigs = torch.linalg.inv(optical_from_world) @ trajectory.world_from_camera.double()
    write_poses(tmp_path / "robot.txt", trajectory.names, rigs @ torch.linalg.inv(base_from_rig))
    run("predict", *of_drive(drive), "output=clean", "outputs=[npz,cloud]")
    words = [word for word in of_drive(drive) if not word.startswith("poses=")]
    run("predict", *words, f"poses={tmp_path}/robot.txt", f"frame={tmp_path}/base.txt", "outputs=[npz,cloud]")
    written = sorted(path.name for path in (tmp_path / "clean").glob("*.npz"))
    assert written == sorted(path.name for path in (tmp_path / "out").glob("*.npz")) != []
    for name in written:
        indices = [np.load(tmp_path / folder / name)["index"] for folder in ("clean", "out")]
        np.testing.assert_allclose(*indices, atol=1e-2)
        ply = name.replace("depth.npz", "points.ply")
        clean, robot = (trimesh.load(tmp_path / folder / ply).vertices for folder in ("clean", "out"))
        np.testing.assert_allclose(robot, clean @ optical_from_world[:3, :3].numpy(), atol=1e-2)


@pytest.mark.parametrize("up", ["-y", "z"])
@pytest.mark.parametrize("inverted", [False, True])
def test_poses_that_are_inverted_are_told(
    drive: Path, capsys: pytest.CaptureFixture[str], inverted: bool, up: str
) -> None:
    trajectory = read_trajectory(drive / "poses.txt")
    optical_from_world = upright_turn(up, torch.eye(4)[None]).double()
    poses = torch.linalg.inv(optical_from_world) @ trajectory.world_from_camera.double()
    write_poses(drive / "poses.txt", trajectory.names, torch.linalg.inv(poses) if inverted else poses)
    source = keys(drive, calibration=f"{drive}/rig.yaml", images=f"{drive}/drive", up=up).open()
    warn_if_inverted(source, up)
    assert ("agree better" in capsys.readouterr().out) == inverted


def test_windows_share_the_nearest_depth_that_one_of_them_has(drive: Path) -> None:
    config = checks.typed(PredictConfig, composed("predict", *of_drive(drive), "up=-y", "min_depth=auto"))
    source = config.capture.open()
    depths = []
    for frame in source.samples():
        assert frame.rig is not None
        assert frame.images is not None
        depths.append(Predictor(frame.rig, method="semi_global", level=4).nearest_depth([frame.images]))
    assert nearest(predictor_for(source.rig, config), source, config, {}) == round(min(depths), 3)


@pytest.mark.parametrize("calibration", ["equirectangular", "camera.yaml", "rig.yaml"])
def test_one_camera_without_poses_is_told_what_is_missing(calibration: str, tmp_path: Path) -> None:
    camera = EquirectangularCamera(SIZE)
    save_camera(camera, tmp_path / "camera.yaml")
    save_rig(CameraRig({"front": camera}, torch.eye(4)[None]), tmp_path / "rig.yaml")
    write_image(tmp_path / "walk/0.png", torch.rand(3, *SIZE))
    path = calibration if calibration == "equirectangular" else str(tmp_path / calibration)
    with pytest.raises(
        ArgumentError, match=r"^calibration: .* is of one camera, .* has no depth: give poses="
    ):
        PosedCapture(calibration=path, images=f"{tmp_path}/walk/*.png").open()


def keys(capture: Path, **given: Any) -> PosedCapture:
    """What ``predict`` is told of where the images and their poses are."""
    return checks.typed(PosedCapture, {**composed("predict", *inputs(capture)), **given})


def inputs(capture: Path) -> tuple[str, ...]:
    return "calibration=equirectangular", f"images={capture / 'walk'}", f"poses={capture / 'poses.txt'}"


def words(capture: Path) -> tuple[str, ...]:
    sweep = "method=semi_global level=3 num_hypotheses=8 min_depth=0.5"
    return inputs(capture) + typed(f"up=z spacing=0.1 {sweep} output=out outputs=[npz] height=16 device=cpu")


def test_windows_are_the_rigs_that_poses_say(run: Run, capture: Path, tmp_path: Path) -> None:
    run("predict", *words(capture))
    written = sorted(path.name for path in (tmp_path / "out").glob("*.npz"))
    assert written == [f"{number:03d}_depth.npz" for number in (1, 2, 4, 5)]  # the fourth stood still
    trajectory = read_trajectory(capture / "poses.txt").turned("z")
    rig = trajectory.rig(EquirectangularCamera(SIZE), [2, 4, 5])
    images = {str(number): read_image(capture / f"walk/{number:03d}.png") for number in (2, 4, 5)}
    predictor = Predictor(rig, SemiGlobalSweep(3, 8, depth_coarsening=1), min_depth=0.5)
    with np.load(tmp_path / "out/004_depth.npz") as arrays:
        np.testing.assert_allclose(arrays["center"], rig.center, atol=1e-6)
        np.testing.assert_allclose(arrays["index"], predictor(images).index, atol=1e-4)


def test_an_image_that_cannot_be_read_takes_its_windows_along(
    failing: Run, capture: Path, tmp_path: Path
) -> None:
    (capture / "walk/005.png").write_bytes(b"no image")
    assert "2 of 4 frames were left out" in failing("predict", *words(capture))
    assert len(list((tmp_path / "out").glob("*.npz"))) == 2


def test_windows_of_a_video_and_of_few_images(capture: Path) -> None:
    writer = cv2.VideoWriter(str(capture / "walk.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 1.0, SIZE[::-1])
    for number in range(NUMBER):
        writer.write(np.full((*SIZE, 3), 30 * number, np.uint8))
    writer.release()
    moving = keys(capture, images=f"{capture}/walk.avi", spacing=0.1, up="z").open()
    assert moving.rig.cameras["000002"].image_size == SIZE
    frames = list(moving.frames(Selection(1, None, 2), lambda _: True))
    assert [frame.name for frame in frames] == ["000002", "000005"]
    assert frames[1].images is not None
    greys = [float(np.asarray(image).mean()) for image in frames[1].images.values()]
    np.testing.assert_allclose(greys, [120, 150, 180], atol=3)
    assert frames[1].rig is not None
    assert frames[1].rig.names == ["000004", "000005", "000006"]
    still = keys(capture, window=2).open()
    (frame,) = still.frames(Selection(2, 3), lambda _: True)
    assert frame.images is None
    assert "in one place" in str(frame.error)


def test_too_few_images_and_unknown_poses_are_told(failing: Run, capture: Path) -> None:
    with pytest.raises(ArgumentError, match=r"spacing: expected 3 poses 0\.4 m apart"):
        keys(capture, spacing=0.4).open()
    assert "with poses there is one camera" in failing("predict", *words(capture), "cameras=[cam1]")


def test_a_rig_that_moves_sees_more_than_one_that_stands(
    run: Run, drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compared: list[tuple[list[str], int]] = []

    def align(predictor: Predictor, frames: Iterable[object]) -> RigTurns:
        compared.append((predictor.rig.names, len(list(frames))))
        return RigTurns.undecided(predictor.rig, "it is not asked for here")

    monkeypatch.setattr("sphericalvision.recipes.commands.predict.align_rig", align)
    said = run("predict", *of_drive(drive), "align=true", "masks=auto")
    assert compared == [(TWO.names, 3)]  # of the rig's own frames, as what follows
    assert "1 frame(s) have no pose within 20 ms" in said
    assert "mask of cam2: " in said
    assert sorted(mask.stem for mask in (tmp_path / "out/masks").glob("*.png")) == TWO.names
    written = sorted(path.name for path in (tmp_path / "out").glob("*.npz"))
    assert written == ["10.204_depth.npz", "10.304_depth.npz"]
    trajectory = read_trajectory(drive / "poses.txt")
    options: Any = {"method": "semi_global", "level": 4, "min_depth": 0.5}
    errors = {}
    for time, window in {"standing": [1], "moving": [0, 1, 2]}.items():
        rig = trajectory.rig(TWO, window)
        names = {view: view.split("@") for view in rig.names}
        files = {v: drive / f"drive/{name}/{float(at) + 0.004:.3f}.png" for v, (name, at) in names.items()}
        found = Predictor(rig, **options)({view: read_image(file) for view, file in files.items()})
        truth = ray_depth(SCENE, rig.center, found.directions).reciprocal()
        errors[time] = float((found.inverse_depth - truth).abs().mean())
        torch.testing.assert_close(rig.center, trajectory.positions[1].float())
    assert errors["moving"] < 0.6 * errors["standing"]
    with np.load(tmp_path / "out/10.204_depth.npz") as arrays:
        np.testing.assert_allclose(arrays["center"], trajectory.positions[1], atol=1e-6)
        np.testing.assert_allclose(arrays["index"], found.index, atol=1e-4)  # of the last, which moved


@pytest.mark.parametrize(("taken", "cameras"), [("drive", ["cam1", "cam2"]), ("capture", ["camera"])])
def test_splat_is_one_data_set_of_all_frames_with_the_images_of_their_moments(
    run: Run, taken: str, cameras: list[str], tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """Of a rig, and of one camera, whose images are rigs only as windows; what goes on begins anew."""
    folder: Path = request.getfixturevalue(taken)
    more = ("outputs=[splat]", "skip_existing=true", "voxel=0.3")
    settings = (*(of_drive(folder) if taken == "drive" else words(folder)), *more)
    run("predict", *settings, "stop=1")
    run("predict", *settings)
    scene = tmp_path / "out/splat/native"
    assert sorted(path.name for path in (scene / "images").iterdir()) == cameras
    frames = sorted(path.stem for path in (scene / "images" / cameras[0]).iterdir())
    images = read_rig(scene / "sparse/0/images.bin", dtype=torch.float64)
    assert images.names == [f"{camera}/{frame}" for frame in frames for camera in cameras]
    changed = (scene / "transforms.json").stat().st_mtime_ns
    run("predict", *settings)  # nothing is left
    assert changed == (scene / "transforms.json").stat().st_mtime_ns
    assert not (tmp_path / "out/fused.npz").exists()
    if taken == "drive":
        assert frames == ["10.104", "10.204", "10.304", "10.404"]  # ends are the middle of no window
        expected = read_trajectory(folder / "poses.txt").rig(TWO, [0, 1, 2, 3])
        torch.testing.assert_close(images.positions.float(), expected.positions, atol=1e-5, rtol=0)
        written, read = scene / "images/cam2/10.304.png", folder / "drive/cam2/10.304.png"
        assert (read_image(written) == read_image(read)).all()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"window": 9}, "window: expected 9 frames with poses or more, got 4 of 5"),
        ({"spacing": 2.0}, r"spacing: expected 3 poses 2 m apart or more, but only 1 of 4"),
        ({"cameras": ["cam7"]}, "cameras: expected names among cam1, cam2"),
        ({"translation_unit": "cm"}, "translation_unit: .* in metres"),
    ],
)
def test_bad_windows_of_a_rig_are_told(drive: Path, given: dict[str, Any], message: str) -> None:
    said = {"calibration": f"{drive}/rig.yaml", "images": f"{drive}/drive", "up": "-y"}
    with pytest.raises(ArgumentError, match=message):
        keys(drive, **said, **given).open()


def test_one_camera_of_a_rig_needs_movement_and_frames_are_those_of_all_cameras(drive: Path) -> None:
    said = {"calibration": f"{drive}/rig.yaml", "images": f"{drive}/drive", "up": "-y", "window": 2}
    said["masks"] = f"{drive}/masks/{{camera}}.png"
    (drive / "drive/cam2/10.304.png").unlink()
    with pytest.warns(UserWarning, match=r"left out are 1 of 5 of cam1 \(10\.304 first\)"):
        moving = keys(drive, **said).open()
    assert list(moving.windows) == ["10.204", "10.404"]
    assert list(moving.rig.masks) == moving.rig.names
    rows = (drive / "poses.txt").read_text().splitlines()
    still = [row.split()[0] + " 0 0 0 0 0 0 1" for row in rows]
    (drive / "poses.txt").write_text("\n".join(still))
    (alone, *_) = keys(drive, **said, cameras=["cam1"]).open().frames(Selection(), lambda _: True)
    assert "10.104, 10.204 are in one place" in str(alone.error)
    with pytest.warns(UserWarning, match="left out are 1 of 5 of cam1"):
        (both, *_) = keys(drive, **said).open().frames(Selection(), lambda _: True)
    assert both.rig is not None
    assert both.rig.names == ["cam1@10.104", "cam2@10.104", "cam1@10.204", "cam2@10.204"]


def test_frames_become_one_cloud_which_a_continuation_goes_on_with(
    run: Run, drive: Path, tmp_path: Path
) -> None:
    words = [*of_drive(drive), "window=2", "outputs=[fused]", "photometric=false"]
    printed = run("predict", *words)
    whole = (tmp_path / "out/fused.ply").read_bytes()
    assert "points of 3 frame(s), one for each cube of 35.0 cm" in printed
    run("predict", *words, "output=again", "stop=1")
    assert "1 frame(s) are complete in " in run("predict", *words, "output=again", "skip_existing=true")
    assert (tmp_path / "again/fused.ply").read_bytes() == whole
    cloud = trimesh.load(tmp_path / "out/fused.ply").vertices
    far = torch.from_numpy(cloud).float() - torch.tensor([0.1, 0, 0.3])
    truth = ray_depth(SCENE, torch.tensor([0.1, 0, 0.3]), torch.nn.functional.normalize(far, dim=-1))
    assert (far.norm(dim=-1) / truth).log().abs().median() < 0.15
