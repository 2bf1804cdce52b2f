# SPDX-License-Identifier: Apache-2.0
"""Prediction on captures: any rig, numbering and scale; every output; mistakes are named."""

from __future__ import annotations

import math
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

import sphericalvision.io.images
import sphericalvision.recipes.commands.predict
from sphericalvision.cameras import ring_rig, save_rig
from sphericalvision.cameras.robot_frame import OPTICAL_FROM_ROS, placed
from sphericalvision.cameras.trajectory import upright_turn
from sphericalvision.capture.writers import read_shares
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.io.images import read_image, write_image
from sphericalvision.models import IcoSweepNet, save_weights
from sphericalvision.recipes.app.rigs import make_ring
from sphericalvision.recipes.datamodules.capture import CaptureDataModule
from sphericalvision.recipes.datamodules.scanned import OwnScansDataModule
from sphericalvision.scenes import make_scene, render_rig
from sphericalvision.scenes.disturbances import CameraDisturbance
from sphericalvision.sphere import Equirectangular
from tests.recipes.conftest import run_recipe
from tests.recipes.tiny import PLATED, Run, typed, write_capture, write_plated_capture

SIZE = (40, 48)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A rig in the package's own format, with two frames of noise and masks."""
    folder = tmp_path / "capture"
    rig = make_ring(4, radius=0.2, image_size=SIZE)
    folder.mkdir()
    rig.to_yaml(folder / "rig.yaml")
    generator = torch.Generator().manual_seed(1)
    for number in range(1, 5):
        for frame in (3, 4):
            image = torch.rand(3, *SIZE, generator=generator)
            write_image(folder / f"cam{number}" / f"{frame:05d}.png", image)
        mask = torch.ones(1, *SIZE)
        mask[:, 20:] = 0
        write_image(folder / f"cam{number}" / "mask.png", mask)
    return folder


def words(capture: Path, weights: Path, output: str) -> tuple[str, ...]:
    images = f"calibration={capture}/rig.yaml images={capture}/cam{{camera}}/{{frame:05d}}.png"
    return typed(f"{images} checkpoint={weights} output={output} height=32 device=cpu align=false")


COARSE = "method=semi_global level=4 num_hypotheses=8 align=false height=16 device=cpu"


def test_depth_of_a_capture_without_a_network(run: Run, capture: Path, weights: Path, tmp_path: Path) -> None:
    more = ("method=semi_global", "num_hypotheses=64", "frames=[3]")
    run("predict", *words(capture, weights, "out"), *more)
    with np.load(tmp_path / "out/00003_depth.npz") as arrays:
        finer = arrays["index"].shape[0]
        assert 4 < arrays["index"].max() <= 63
        assert arrays["depth_panorama"].shape == (32, 64)
    run("predict", *words(capture, weights, "net"), "frames=[3]")
    with np.load(tmp_path / "net/00003_depth.npz") as arrays:
        assert finer == 4 * arrays["index"].shape[0] - 6  # one level more


def test_a_world_whose_z_is_up_and_a_robots_frame(run: Run, tmp_path: Path) -> None:
    """A rig whose calibration lies on its side has the depth of the upright one, and points where a robot has them."""
    rig, folder = make_ring(3, radius=0.2, image_size=(48, 48)), tmp_path / "c"
    scene = make_scene("room", seed=3)
    write_capture(folder, rig, render_rig(scene, rig, 2), file="{camera}/1.png")
    lying = placed(rig, torch.linalg.inv(upright_turn("z", rig.world_from_camera)))
    save_rig(lying, folder / "z_up.yaml")
    base_from_rig = torch.eye(4)
    base_from_rig[:3, :3] = OPTICAL_FROM_ROS[:3, :3].T
    base_from_rig[:3, 3] = torch.tensor([0.3, 0.0, 1.2])
    base_from_lying = base_from_rig @ upright_turn("z", rig.world_from_camera)
    np.savetxt(tmp_path / "base.txt", base_from_lying, delimiter=",")
    outputs = {
        "clean": "calibration=c/rig.yaml",
        "sideways": "calibration=c/z_up.yaml",
        "upright": "calibration=c/z_up.yaml up=z",
        "robot": "calibration=c/z_up.yaml frame=base.txt",
    }
    said, results = {}, {}
    for name, words in outputs.items():
        more = f"output={name} {COARSE} outputs=[npz,cloud]"
        said[name] = run("predict", *typed(f"{words} images=c {more}"))
        (npz,) = (tmp_path / name).glob("*depth.npz")
        (ply,) = (tmp_path / name).glob("*points.ply")
        results[name] = np.load(npz), trimesh.load(ply).vertices
    assert "mean down is 90° from the world's down" in said["sideways"]
    assert not any("mean down" in said[name] for name in ("clean", "upright", "robot"))
    for name in ("upright", "robot"):
        np.testing.assert_allclose(results[name][0]["index"], results["clean"][0]["index"], atol=1e-2)
    in_base = trimesh.transform_points(results["clean"][1], base_from_rig.numpy())
    np.testing.assert_allclose(results["robot"][1], in_base, atol=1e-2)


def test_a_field_of_view_that_the_calibration_does_not_tell_is_that_of_the_images(
    run: Run, tmp_path: Path
) -> None:
    rig, folder = ring_rig(3, 0.2, (64, 64), math.radians(190)), tmp_path / "c"
    write_capture(folder, rig, render_rig(make_scene("room", seed=3), rig, 2), file="{camera}/1.png")
    cameras = {name: camera.with_max_angle(math.radians(130)) for name, camera in rig.cameras.items()}
    save_rig(rig.replaced(cameras), folder / "wide.yaml")
    results = {}
    for name, words in {"rig": "rig.yaml", "wide": "wide.yaml", "told": "wide.yaml max_angle_deg=95"}.items():
        told = run(*typed(f"predict calibration=c/{words} images=c output={name} {COARSE}"))
        assert ("cam1 is dark beyond 95°" in told) == (name == "wide")
        results[name] = np.load(next((tmp_path / name).glob("*.npz")))["index"]
    np.testing.assert_allclose(results["wide"], results["rig"], atol=1e-2)
    np.testing.assert_allclose(results["told"], results["rig"], atol=1e-2)
    told = run("inspect", *typed("calibration=c/wide.yaml images=c/{camera}/{frame}.png level=3"))
    assert "cam3 is dark beyond 95°" in told
    for name in rig.names:
        shutil.copy(folder / name / "1.png", folder / name / "2.png")
    given = {"images": f"{folder}/{{camera}}/{{frame}}.png", "calibration": f"{folder}/wide.yaml"}
    for data in (CaptureDataModule(**given, world={}), OwnScansDataModule(**given, points=str(folder))):
        assert data.source.rig.cameras["cam3"].max_angle == pytest.approx(math.radians(95), abs=0.01)


def test_what_is_compensated_is_said(run: Run, weights: Path, tmp_path: Path) -> None:
    rig = make_ring(4, radius=0.2, image_size=(96, 96))
    pictures = render_rig(make_scene("room", seed=3), rig, 2)
    for folder, factor in ((tmp_path / "even", 1.0), (tmp_path / "dark", 0.6)):
        taken = {**pictures, "cam1": factor * pictures["cam1"]}
        write_capture(folder, rig, taken, file="{camera}/00003.png")
    assert "compensates" not in run("predict", *words(tmp_path / "even", weights, "out"), "outputs=[npz]")
    told = run("predict", *words(tmp_path / "dark", weights, "out_dark"), "outputs=[npz]")
    least, most = re.findall(r"compensates exposures of (\S+) to (\S+) of", told)[0]
    assert abs(float(least) / float(most) - 0.6) < 0.06
    dark = words(tmp_path / "dark", weights, "out_off")
    assert "compensates" not in run("predict", *dark, "outputs=[npz]", "photometric=false")


def test_images_and_network_are_read_once(
    run: Run, capture: Path, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded: list[str] = []
    networks: list[object] = []
    read, load = sphericalvision.io.images._decoded, sphericalvision.recipes.commands.predict.read_network

    def read_pages(path: Path, *more: object) -> object:
        decoded.append(str(path))
        return read(path, *more)  # type: ignore[arg-type]

    def read_network(weights: object) -> object:
        networks.append(weights)
        return load(weights)  # type: ignore[arg-type]

    monkeypatch.setattr(sphericalvision.io.images, "_decoded", read_pages)
    monkeypatch.setattr(sphericalvision.recipes.commands.predict, "read_network", read_network)
    run("predict", *words(capture, weights, "out"), "align=true", "min_depth=scene", "outputs=[npz]")
    assert sorted(decoded) == sorted(map(str, capture.glob("cam*/0*.png")))
    assert len(networks) == 1


def test_knocked_cameras_are_turned_and_it_is_said(run: Run, tmp_path: Path) -> None:
    """The rig that it writes gives the same depth; to the last digit where a folder goes on."""
    rig = make_ring(4, image_size=(256, 256))
    pictures = render_rig(make_scene("room", seed=5), rig)
    fault = CameraDisturbance(pose_error=math.radians(1))
    wrong = fault({"images": pictures, "rig": rig}, torch.Generator().manual_seed(2))["rig"]
    write_capture(tmp_path / "c", wrong, pictures, file="{camera}/00003.png")
    images = f"images={tmp_path}/c/cam{{camera}}/{{frame:05d}}.png"
    turn = transform_from_axis_angle(torch.tensor([0.03, 0.02, 0.1]), torch.tensor([0.1, 0.2, 1.5]))
    np.savetxt(tmp_path / "base.txt", turn @ OPTICAL_FROM_ROS.mT)
    common = typed(f"{images} frame={tmp_path}/base.txt checkpoint=icosweepnet-small outputs=[npz] height=64")
    first = [f"calibration={tmp_path}/c/rig.yaml", "output=turned", *common]
    assert "preparation turns cam1 by" in run("predict", *first)
    depth = tmp_path / "turned/00003_depth.npz"
    before = np.load(depth)["index"]
    depth.unlink()
    assert "preparation turns" not in run("predict", *first, "skip_existing=true")
    run("predict", f"calibration={tmp_path}/turned/aligned.yaml", "output=again", *common, "align=false")
    np.testing.assert_array_equal(np.load(depth)["index"], before)
    np.testing.assert_allclose(np.load(tmp_path / "again/00003_depth.npz")["index"], before, atol=1e-3)


def test_masked_pixels_have_no_influence(run: Run, capture: Path, weights: Path, tmp_path: Path) -> None:
    """And masks beside the images are no frames."""
    beside = [f"images={capture}/cam{{camera}}/{{frame}}.png", f"masks={capture}/cam{{camera}}/mask.png"]
    run("predict", *words(capture, weights, "before"), *beside)
    written = sorted(path.name for path in (tmp_path / "before").glob("*.npz"))
    assert written == ["00003_depth.npz", "00004_depth.npz"]
    for path in capture.glob("cam*/00003.png"):
        image = read_image(path)
        image[:, 22:] = 1 - image[:, 22:]
        write_image(path, image)
    run("predict", *words(capture, weights, "after"), *beside, "stop=1")
    before, after = (np.load(tmp_path / name / "00003_depth.npz")["index"] for name in ("before", "after"))
    np.testing.assert_allclose(after, before, atol=1e-5)


def test_a_camera_that_a_mask_leaves_next_to_nothing_of_sees_nothing(
    run: Run, failing: Run, capture: Path, weights: Path, tmp_path: Path
) -> None:
    mask = np.zeros(SIZE, np.uint8)
    cv2.imwrite(str(capture / "cam2/mask.png"), mask)
    given = [*words(capture, weights, "out"), f"masks={capture}/cam{{camera}}/mask.png", "frames=[3]"]
    assert f"{capture}/cam2/mask.png: the mask leaves nothing" in failing("predict", *given)
    mask[20, 24] = 1
    cv2.imwrite(str(capture / "cam2/mask.png"), mask)
    run("predict", *given)
    assert len(trimesh.load(tmp_path / "out/00003_points.ply").vertices)


def test_the_rigs_own_body_is_masked(run: Run, weights: Path, tmp_path: Path) -> None:
    """A dark plate that stands still in the pictures of one camera; a capture of few frames is not masked."""
    folder = write_plated_capture(tmp_path / "moving")
    given = typed(
        f"calibration={folder}/rig.yaml images={folder}/{{camera}}/{{frame}}.png height=32 align=false"
    )
    given += typed(f"checkpoint={weights} masks=auto outputs=[npz]")
    told = run("predict", *given, "output=out", "stop=1")
    masks = {name: read_image(tmp_path / f"out/masks/{name}.png")[0] for name in PLATED.names}
    assert not masks["cam2"][72:90, 30:66].any()
    assert masks["cam2"][:54].all()
    assert all(masks[name].all() for name in PLATED.names if name != "cam2")
    assert re.search(r"mask of cam2: 2\d\.\d % of its picture\n", told)
    assert "mask of cam1: 0.0 % of its picture (no body was seen)" in told
    told = run("predict", *given, "output=few", "frames=[1,2]")
    assert read_image(tmp_path / "few/masks/cam2.png").min() == 1
    assert "2 different view(s) of 2 frame(s), at least 8 are needed" in told


@pytest.mark.slow
def test_photo_consistency_is_printed_and_kept(
    run: Run, capture: Path, weights: Path, tmp_path: Path
) -> None:
    sweep = (*words(capture, weights, "out"), "method=semi_global", "outputs=[consistency]")
    printed = run("predict", *sweep)
    header, *rows = (tmp_path / "out" / "consistency.csv").read_text().splitlines()
    assert header == "frame,photo_consistency"
    shares = [float(row.split(",")[1]) for row in rows]
    assert all(0 < share < 1 for share in shares)
    assert f"photo-consistency: {sum(shares) / len(shares):.3f} of" in printed
    run("predict", *sweep, "skip_existing=true", "stop=1")
    # one frame gets all threads, two share them: sums are rounded otherwise, and the table has four digits
    again = list(read_shares(tmp_path / "out" / "consistency.csv").values())
    assert again == pytest.approx(shares, abs=5e-4)


def test_prediction_goes_on_where_it_stopped(
    run: Run, failing: Run, capture: Path, weights: Path, tmp_path: Path
) -> None:
    """Frames that cannot be read are left out, of the calibration's judgement, too; what is done is not done again."""
    aligned = (*words(capture, weights, "out"), "align=true")
    good = (capture / "cam3/00003.png").read_bytes()
    (capture / "cam3/00003.png").write_bytes(good[:50])
    message = failing("predict", *aligned)
    assert "1 of 2 frames were left out" in message
    assert "cam3/00003.png" in message
    assert not (tmp_path / "out/00003_depth.npz").exists()
    first = (tmp_path / "out/00004_depth.npz").stat().st_mtime_ns
    failing("predict", *words(capture, weights, "other"), "on_error=stop")
    assert not (tmp_path / "other/00004_depth.npz").exists()
    (capture / "cam3/00003.png").write_bytes(good)
    run("predict", *aligned, "skip_existing=true")
    assert (tmp_path / "out/00003_depth.npz").is_file()
    assert (tmp_path / "out/00004_depth.npz").stat().st_mtime_ns == first
    message = failing("predict", *aligned, "skip_existing=true", "height=24")
    assert "holds results of other settings (height was" in message
    assert "is 24)" in message
    save_weights(IcoSweepNet(3, 4, feature_channels=2), weights)
    assert "(network was " in failing("predict", *aligned, "skip_existing=true")


LEFT: dict[str, tuple[str, bytes]] = {
    "empty settings": ("config.yaml", b""),
    "settings that are no YAML": ("config.yaml", b"a: [\n"),
    "settings that are no text": ("config.yaml", b"\xff\xfe\x00"),
    "settings that are a list": ("config.yaml", b"- 1\n"),
    "a record that is no text": ("frames.jsonl", b"\xff\n"),
    "a table that is no text": ("consistency.csv", b"frame,photo_consistency\n\xff,0.5\n"),
    "an empty cloud": ("fused.npz", b""),
    "a cloud that is none": ("fused.npz", b"PK\x03\x04 and no more"),
    "a calibration that is none": ("aligned.yaml", b"cameras: 3\n"),
}
"""What is wrong -> a file of an earlier run, and what a broken disk left of it."""


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a capture and, in ``out``, its frames in several outputs."""
    folder = tmp_path_factory.mktemp("swept")
    rig = ring_rig(3, image_size=(32, 32))
    frames = (render_rig(make_scene("bare", seed=seed), rig) for seed in (0, 2))
    write_capture(folder, rig, *frames)
    run_recipe(folder, "predict", *SWEEP)
    return folder


SWEEP = ["calibration=rig.yaml", "images={camera}/{frame}.png", "method=semi_global", "level=4", "output=out"]
SWEEP += ["min_depth=0.5", "height=16", "outputs=[npz,consistency,fused]", "align=false"]


@pytest.mark.parametrize("damage", LEFT)
def test_what_a_broken_disk_left_is_told(swept: Path, tmp_path: Path, failing: Run, damage: str) -> None:
    name, content = LEFT[damage]
    shutil.copytree(swept, tmp_path, dirs_exist_ok=True)
    (tmp_path / "out" / name).write_bytes(content)
    message = failing("predict", *SWEEP, "skip_existing=true")
    assert f"out/{name}" in message
    assert "Traceback" not in message


def test_a_folder_goes_on_with_the_same_files_alone(
    swept: Path, tmp_path: Path, run: Run, failing: Run
) -> None:
    """Files under the names that settings have may hold something else by now; other runs may have come between."""
    shutil.copytree(swept, tmp_path, dirs_exist_ok=True)
    assert "2 frame(s) are complete in" in run("predict", *SWEEP, "skip_existing=true")
    first = (tmp_path / "rig.yaml").read_bytes()
    save_rig(ring_rig(3, radius=0.21, image_size=(32, 32)), tmp_path / "rig.yaml")
    assert "(rig was " in failing("predict", *SWEEP, "skip_existing=true")
    (tmp_path / "rig.yaml").write_bytes(first)
    for more in ((), ("skip_existing=true",)):
        assert "(level was 4, is 3)" in failing("predict", *SWEEP, "level=3", *more)
    with np.load(tmp_path / "out/0_depth.npz") as arrays:
        assert len(arrays["index"]) == 10 * 4**3 + 2


def test_a_torn_table_of_consistency_loses_its_last_line_alone(tmp_path: Path) -> None:
    table = tmp_path / "consistency.csv"
    assert read_shares(table) == {}
    table.write_text('frame,photo_consistency\n1,0.9134\n"a\nb,c",0.5\n2,0.8')
    assert read_shares(table) == {"1": 0.9134, "a\nb,c": 0.5}


def test_what_only_one_camera_sees_is_not_shown_as_measured(
    run: Run, capture: Path, weights: Path, tmp_path: Path
) -> None:
    """Two cameras of 220 degrees back to back: both see a belt on either side of the plane between them, if far."""
    more = ("cameras=[cam1,cam3]", "frames=[3]", "height=64")
    printed = run("predict", *words(capture, weights, "out"), *more)
    with np.load(tmp_path / "out/00003_depth.npz") as arrays:
        matched, directions = arrays["matched_panorama"], Equirectangular(64, 128).directions.numpy()
        center, depth = arrays["center"], arrays["depth_panorama"]
    (share,) = re.findall(r"Two cameras see (\d+) %", printed)
    assert 0 < int(share) < 40
    assert not matched[np.abs(directions[..., 2]) > np.sin(np.radians(50))].any()
    points = np.asarray(trimesh.load(tmp_path / "out/00003_points.ply").vertices) - center
    assert 0 < len(points) <= (matched & np.isfinite(depth)).sum()


def test_mistakes_are_named(failing: Run, capture: Path, weights: Path, tmp_path: Path) -> None:
    good = words(capture, weights, "out")
    # A concatenation
    four = save_weights(IcoSweepNet(3, 4, feature_channels=2), tmp_path / "four.safetensors")
    three = failing("predict", *words(capture, four, "out"), "cameras=[cam1,cam2,cam3]")
    assert "has 3 cameras" in three
    assert "checkpoint is for 4" in three
    make_ring(4, image_size=(64, 64)).to_yaml(capture / "rig.yaml")
    size = failing("predict", *good)
    assert "00003.png" in size
    assert "64 x 64" in size
    assert "48 x 40" in size
