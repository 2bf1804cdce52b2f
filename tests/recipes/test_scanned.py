# SPDX-License-Identifier: Apache-2.0
"""Sets with scanned truth, on fixtures of their layouts that the renderer makes: read, evaluated, refused."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import (
    CameraRig,
    KannalaBrandtCamera,
    read_camera,
    read_trajectory,
    ring_rig,
    save_camera,
    save_rig,
)
from sphericalvision.core import ArgumentError, FileFormatError, MissingFileError
from sphericalvision.data.scanned.deep360 import Deep360Dataset
from sphericalvision.data.scanned.helvipad import (
    BASELINE,
    HELVIPAD_LATITUDES,
    HelvipadDataset,
    disparity_from_depth,
)
from sphericalvision.data.scanned.kitti360 import Kitti360Dataset
from sphericalvision.data.scanned.omnipus import OmniPusDataset
from sphericalvision.data.scanned.own import OwnScans
from sphericalvision.data.scanned.scanned_frames import ScannedFrames, read_raster
from sphericalvision.data.scanned.spires import SpiresDataset
from sphericalvision.data.scanned.widedepth import WideDepthDataset
from sphericalvision.io.images import write_image, write_pages
from sphericalvision.recipes.datamodules.scanned import HelvipadDataModule, OwnScansDataModule
from sphericalvision.scenes import Scene, ray_depth, render_rig
from sphericalvision.sphere import Equirectangular
from tests.recipes.scanned_sets import (
    ROAD,
    SCENE,
    SCENES,
    SEQUENCE,
    SITE,
    WIDE,
    write_deep360,
    write_helvipad,
    write_kitti360,
    write_omnipus,
    write_own,
    write_spires,
    write_widedepth,
)
from tests.recipes.tiny import TINY_SCENES, TINY_TRAINING, Run, command_after, typed, write_streams

TINY_NETWORK = tuple(word for word in TINY_TRAINING if word not in TINY_SCENES)


def right_share(sample: dict[str, Any], center: Tensor, scene: Scene = SCENE) -> float:
    """Share of what is valid on the panorama of a sample that is right within 2 %."""
    depth = ray_depth(scene, center, Equirectangular(*sample["inverse_depth"].shape).directions)
    right = (sample["inverse_depth"] * depth - 1).abs() < 0.02
    assert sample["valid"].float().mean() > 0.05
    return float(right[sample["valid"]].float().mean())


def test_every_layout_gives_the_truth_that_was_rendered(tmp_path: Path) -> None:
    helvipad = HelvipadDataset(write_helvipad(tmp_path / "h"), "test", height=32)
    kitti = Kitti360Dataset(write_kitti360(tmp_path / "k"), [SEQUENCE], spacing=0.1, height=32)
    spires = SpiresDataset(write_spires(tmp_path / "s"), [SITE], height=32)
    omnipus = OmniPusDataset(write_omnipus(tmp_path / "o"), "test", height=64)
    deep360 = Deep360Dataset(write_deep360(tmp_path / "d"), "test", height=64)
    with pytest.warns(UserWarning, match="the set tells no lens; it is taken for equidistant, 195°"):
        widedepth = WideDepthDataset(write_widedepth(tmp_path / "w"), height=64, stereo="both")
    for frames in (helvipad, kitti, spires, omnipus, deep360, widedepth):
        assert len(frames) == 1, frames
        sample = frames[0]
        rig = sample["rig"]
        assert list(sample["images"]) == rig.names
        scene = ROAD if frames is deep360 else SCENE
        assert right_share(sample, rig.center, scene) > 0.97, frames
        assert (sample["inverse_depth"][~sample["valid"]] == 0).all()
        rendered = render_rig(scene, rig, samples_per_pixel=1)
        for name, image in sample["images"].items():
            seen = sample["seen"][name]
            assert (image - rendered[name]).abs().mean(0)[seen].median() < 0.03, (frames, name)
    learned, judged = (
        HelvipadDataModule(root=str(helvipad.root), augmented=True).frames(split, 32, dict)
        for split in ("train", "test")
    )
    assert len(learned.points(learned.names[0])) > len(judged.points(judged.names[0]))
    assert OmniPusDataset(omnipus.root, "train").names == ["omnipusa/omnipusA_case2/000000"]
    assert deep360.names == ["ep1_500frames/testing/002505"]
    assert "1 of 2 frames were left out" in spires.left_out[0]
    assert "the first, 002_010_000, lacks 002_010_000/195FOV/65mm/DOWN/fisheye.png" in widedepth.left_out[0]


def test_widedepth_has_its_choices_and_a_lens_of_ones_own(tmp_path: Path) -> None:
    root = write_widedepth(tmp_path / "w")
    save_camera(WIDE, tmp_path / "lens.yaml")
    lens = tmp_path / "lens.yaml"
    for stereo, place in (("horizontal", [0.065, 0.0, 0.0]), ("vertical", [0.0, 0.065, 0.0])):
        frames = WideDepthDataset(root, [SCENES[0]], height=24, stereo=stereo, calibration=lens)
        assert torch.allclose(frames.fixed_rig.positions[1], torch.tensor(place))
        assert frames.fixed_rig.cameras["center"].equals(read_camera(lens))
        points = frames.points(SCENES[0])
        true = ray_depth(SCENE, torch.zeros(3), torch.nn.functional.normalize(points, dim=-1))
        assert (points.norm(dim=-1) - true).abs().max() < 0.002  # metres
    assert len(WideDepthDataset(root, calibration=lens)) == 2
    for wrong in ({"field_of_view": 180}, {"baseline": 66}, {"stereo": "left"}):
        with pytest.raises(ArgumentError, match=next(iter(wrong))):
            WideDepthDataset(root, **wrong)
    with pytest.raises(MissingFileError, match="no scene 'hall'; it has 2, 001_057_000"):
        WideDepthDataset(root, ["hall"])
    with pytest.raises(MissingFileError, match=r"lacks \d{3}_\d{3}_\d{3}/120FOV/65mm/CENTER/fisheye\.png"):
        WideDepthDataset(root, field_of_view=120)
    save_camera(WIDE.resized((72, 128)), lens)
    with pytest.raises(FileFormatError, match="expected a camera of 36 x 64 pixels"):
        WideDepthDataset(root, calibration=lens)


@pytest.mark.parametrize(
    ("write", "splits"),
    [
        (write_helvipad, ()),
        (write_kitti360, (f"[{SEQUENCE}]", "data.spacing=0.1")),
        (write_spires, (f"[{SITE}]",)),
        (write_omnipus, ()),
        (write_deep360, ()),
        pytest.param(
            write_widedepth,
            (f"[{SCENES[0]}]",),
            marks=pytest.mark.filterwarnings("ignore:.*tells no lens"),
        ),
    ],
)
def test_published_sets_are_trained_and_evaluated_by_the_commands(
    write: Callable[[Path], Path], splits: tuple[str, ...], run: Run, tmp_path: Path
) -> None:
    root = write(tmp_path / "None of it")
    name = write.__name__.removeprefix("write_")
    named = [f"data.{split}={splits[0]}" for split in ("train", "val", "test") if splits]
    more = (*named, *splits[1:], "data.truth_height=24", "data.num_workers=0")
    words = (f"data={name}", f"data.root={root}", *more)
    one = ("trainer.max_steps=1", "trainer.val_check_interval=1", "callbacks.panels=null")
    printed = run("train", *TINY_NETWORK, *words, *one, "output=trained")
    assert (tmp_path / "trained" / "checkpoints" / "best.safetensors").is_file()
    printed = run("evaluate", *command_after(printed, "Evaluate: ")[1:], "output=out", "device=cpu")
    assert (tmp_path / "out" / "metrics.json").is_file()
    assert ("1 of 2 frames were left out" in printed) == (name == "spires")
    assert ("* published" in printed) == (name == "helvipad")
    if name == "helvipad":
        table = (tmp_path / "out" / "published.csv").read_text()
        ours = [float(word) for word in table.splitlines()[1].split(",")[1:] if word]
        assert len(ours) == 7
        assert all(0 <= value < 300 for value in ours)
        assert "PSMNet *,2.509" in table


@pytest.mark.slow
def test_a_scan_of_ones_own_beside_its_images_is_evaluated(
    run: Run, weights: Path, tmp_path: Path, failing: Run
) -> None:
    rig = ring_rig(4, image_size=(32, 32))
    write_own(tmp_path, rig, ("1", "2"))
    pose = read_trajectory(tmp_path / "lidar.txt").world_from_camera[0].float()
    images = f"data.images={tmp_path}/{{camera}}/{{frame}}.png data.calibration={tmp_path}/rig.yaml"
    more = f"data.points={tmp_path}/scans data.truth_height=32 data.num_workers=0"
    words = typed(f"data=scanned {images} {more}")
    run("evaluate", f"checkpoint={weights}", *words, f"data.lidar_pose={tmp_path}/lidar.txt", "output=out")
    assert (tmp_path / "out" / "metrics.json").is_file()
    files = {"1": {name: tmp_path / name / "1.png" for name in rig.names}}
    good = OwnScans(files, rig, tmp_path / "scans", pose, height=32)
    assert right_share(good[0], rig.center) > 0.97

    far = torch.eye(4)
    far[0, 3] = 1000.0
    with pytest.warns(UserWarning, match=r"tell the depth of 0\.0% of all directions"):
        _ = OwnScans(files, rig, tmp_path / "scans", far, height=32)[0]
    narrow = CameraRig(
        {"front": KannalaBrandtCamera([40.0, 40.0], [15.5, 15.5], [0.0] * 4, (32, 32))}, torch.eye(4)[None]
    )
    files["1"] = {"front": tmp_path / "cam1" / "1.png"}
    with pytest.warns(UserWarning, match="of the points of 1; expected half"):
        _ = OwnScans(files, narrow, tmp_path / "scans", far, height=32)[0]
    shutil.rmtree(tmp_path / "scans")
    assert "points: " in failing("evaluate", f"checkpoint={weights}", *words)


@pytest.mark.parametrize("images", ["{camera}.avi", "{frame}.png"])
def test_scans_lie_beside_image_files_alone(tmp_path: Path, images: str) -> None:
    rig = ring_rig(2, image_size=(16, 16))
    write_own(tmp_path, rig, ("1",))
    for name in rig.names:
        write_streams(tmp_path / f"{name}.avi", [[np.zeros((16, 16, 3), np.uint8)] * 2], "mjpeg")
    write_image(tmp_path / "1.png", torch.zeros(3, 16, 32))
    with pytest.raises(ArgumentError, match="images: scans lie beside image files, one for each camera"):
        own_scans(tmp_path, images=f"{tmp_path}/{images}")


def own_scans(folder: Path, **keys: Any) -> OwnScansDataModule:
    places = {"images": f"{folder}/{{camera}}/{{frame}}.png", "calibration": f"{folder}/rig.yaml"}
    return OwnScansDataModule(points=f"{folder}/scans", **{**places, **keys})


def test_the_tolerance_is_that_between_cameras_too(tmp_path: Path) -> None:
    write_own(tmp_path, ring_rig(2, image_size=(16, 16)), ("1700000000.00",))
    (tmp_path / "cam2/1700000000.00.png").rename(tmp_path / "cam2/1700000000.03.png")
    with pytest.raises(MissingFileError, match=r"0\.03 s away; tolerance is 0\.02"):
        own_scans(tmp_path)
    data = own_scans(tmp_path, tolerance=0.033)
    assert data.source.pairing.endswith("30 ms apart at most")
    assert data.frames("test", 32, dict).names == ["1700000000.00"]


def test_frames_that_are_called_as_rendered_rooms_are_none(run: Run, weights: Path, tmp_path: Path) -> None:
    write_own(tmp_path, ring_rig(4, image_size=(16, 16)), ("room-1",))
    words = ("data.images={camera}/{frame}.png", "data.calibration=rig.yaml", "data.points=scans")
    tables = {}
    for name, more in {"usual": (), "far": ("max_depth_m=80",)}.items():
        given = ("data=scanned", *words, "data.lidar_pose=lidar.txt", "data.num_workers=0", *more)
        run("evaluate", f"checkpoint={weights}", "device=cpu", f"output={name}", *given)
        tables[name] = (tmp_path / name / "metrics.md").read_text()
    assert tables["usual"] == tables["far"]


def test_scans_and_rigs_far_from_the_origin_are_as_exact(tmp_path: Path) -> None:
    """Both in UTM, in double precision."""
    rig, place = ring_rig(2, image_size=(16, 16)), torch.tensor([500_000.0, 10.0, 4_600_000.0]).double()
    write_own(tmp_path, rig, ("1",))
    (near,) = own_scans(tmp_path).frames("test", 32, dict)
    poses = rig.world_from_camera.double()
    poses[:, :3, 3] += place
    save_rig(CameraRig(rig.cameras, poses), tmp_path / "rig.yaml")
    np.save(tmp_path / "scans/1.npy", np.load(tmp_path / "scans/1.npy").astype(float) + place.numpy())
    (far,) = own_scans(tmp_path).frames("test", 32, dict)
    assert torch.equal(near["valid"], far["valid"])
    torch.testing.assert_close(near["inverse_depth"], far["inverse_depth"], rtol=1e-5, atol=1e-6)


def test_a_scanner_has_one_pose(tmp_path: Path) -> None:
    write_own(tmp_path, ring_rig(2, image_size=(16, 16)), ("1",))
    path = tmp_path / "lidar.txt"
    assert len(own_scans(tmp_path, lidar_pose=str(path)).frames("test", 32, dict)) == 1
    path.write_text(2 * path.read_text())
    with pytest.raises(ArgumentError, match=r"data.lidar_pose: expected one pose, .*got 2 in .*lidar.txt"):
        own_scans(tmp_path, lidar_pose=str(path)).frames("test", 32, dict)


def test_scans_belong_to_images_of_their_time(tmp_path: Path) -> None:
    rig = ring_rig(2, image_size=(8, 8))
    for stamp in ("1700000000.01", "1700000003.00"):
        np.save(tmp_path / f"{stamp}.npy", np.ones((2, 3)))
    images = {name: {} for name in ("1700000000.02", "1700000002.00")}
    scans = OwnScans(images, rig, tmp_path)
    assert scans.names == ["1700000000.02"]
    assert "1 of 2 frames were left out; the first, 1700000002.00" in scans.left_out[0]
    with pytest.raises(MissingFileError, match="no complete frame"):
        OwnScans(images, rig, tmp_path, tolerance=0.001)
    some = {name: {} for name in ("1700000000.02", "1700000003.00")}  # one at the very time
    assert OwnScans(some, rig, tmp_path).names == list(some)
    (tmp_path / "1700000003.00.npy").rename(tmp_path / "left.pcd.bin")
    assert OwnScans({"left": {}}, rig, tmp_path).names == ["left"]


@pytest.mark.parametrize(
    ("frames", "write", "split", "truth"),
    [
        (HelvipadDataset, write_helvipad, "train", "train/depth_maps/20240120_REC_06_IN/0042.png"),
        (Deep360Dataset, write_deep360, "training", "ep1_500frames/training/depth/002505_depth.npz"),
    ],
)
def test_sets_without_their_splits_and_truth_of_another_size_are_refused(
    frames: Callable[..., ScannedFrames], write: Callable[..., Path], split: str, truth: str, tmp_path: Path
) -> None:
    root = write(tmp_path / "set", (split,))
    with pytest.raises(MissingFileError, match="splits"):
        frames(root, "test")
    with pytest.raises(ArgumentError, match="split"):
        frames(root, "holdout")
    small = np.ones((9, 9), np.uint16)
    if truth.endswith(".npz"):
        np.savez(root / truth, small)
    else:
        write_pages(root / truth, [small])
    with pytest.raises(FileFormatError, match="of one size"):
        _ = frames(root, "train")[0]
    (root / truth).write_bytes(b"no picture")
    with pytest.raises(FileFormatError, match=Path(truth).name):
        _ = frames(root, "train")[0]


@pytest.mark.parametrize(("kind", "factor"), [(np.uint16, 0.25), (np.float32, 1.0), (np.float64, 1.0)])
def test_only_whole_numbers_of_a_raster_are_divided(kind: type, factor: float, tmp_path: Path) -> None:
    values = np.array([[1, 2, 700], [4, 0, 6]], kind)
    write_pages(tmp_path / "a.tiff", [values])
    assert read_raster(tmp_path / "a.tiff", 4.0, (2, 3), "depth").tolist() == (factor * values).tolist()


def test_a_sequence_without_scans_is_told(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"nothing.*cloud_"):
        SpiresDataset(write_spires(tmp_path), ["nothing"])
    root = write_kitti360(tmp_path / "k")
    (root / "calibration/calib_cam_to_pose.txt").write_text("")
    with pytest.raises(MissingFileError, match="no transform in it"):
        Kitti360Dataset(root, [SEQUENCE])


def test_disparity_is_the_angle_between_both_cameras() -> None:
    rays = Equirectangular(12, 24, torch.float64, latitudes=HELVIPAD_LATITUDES).directions
    depth = torch.rand(12, 24, dtype=torch.float64) * 5 + 0.5
    to_top = depth[..., None] * rays - torch.tensor([0.0, -BASELINE, 0.0])
    cosine = (torch.nn.functional.normalize(to_top, dim=-1) * rays).sum(-1)
    assert torch.allclose(disparity_from_depth(depth, rays), cosine.acos().rad2deg(), atol=1e-6)
    theta = (1535 - 2 * torch.arange(512, dtype=torch.float64)) * math.pi / 1920
    rows = Equirectangular(512, 4, torch.float64, latitudes=HELVIPAD_LATITUDES).directions[:, 0, 1]
    assert torch.allclose(rows, theta.cos(), atol=1e-12)


def test_motion_of_a_turn_is_that_between_poses_divided_by_turns(tmp_path: Path) -> None:
    """KITTI-360 leaves frames without a pose out."""
    frames = Kitti360Dataset(write_kitti360(tmp_path), [SEQUENCE], spacing=0.1, height=16)
    trajectory = read_trajectory(tmp_path / "data_poses" / SEQUENCE / "poses.txt")
    for one, third in zip(
        frames._motion(trajectory, [5, 6, 7], 1), frames._motion(trajectory, [3, 6, 7], 1), strict=True
    ):
        assert one.norm() > 0.01
        torch.testing.assert_close(3 * third, one)


def test_images_that_are_no_part_of_helvipads_are_refused(tmp_path: Path) -> None:
    root = write_helvipad(tmp_path, ("test",))
    write_image(root / "test/images_bottom/20240120_REC_06_IN/0042.jpg", torch.zeros(3, 64, 200))
    with pytest.raises(FileFormatError, match=r"0042\.jpg: expected 1920 x 512 pixels .* got 200 x 64"):
        HelvipadDataset(root, "test")
