# SPDX-License-Identifier: Apache-2.0
"""Cameras and rigs from rendered pictures of boards, whose truth is known, from the command line."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sphericalvision.cameras import FisheyeCamera, KannalaBrandtCamera, read_camera, read_rig, ring_rig
from sphericalvision.capture import AprilGrid, Charuco
from sphericalvision.core import ArgumentError
from sphericalvision.geometry import angle_from_axis
from sphericalvision.io.images import read_image, write_image
from sphericalvision.recipes.commands import calibrate as commands
from tests.capture.test_calibrate_rig import SIZE, calibrated, grid_of, seen_by, truth
from tests.recipes.board_pictures import (
    COLUMNS,
    ROWS,
    SQUARE,
    TRUTH,
    AnyBoard,
    Drawing,
    Eye,
    around,
    back_to_back,
    write_boards,
)
from tests.recipes.tiny import Run, typed, write_streams

TARGET = "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 6\ntagSize: 0.07\ntagSpacing: 0.3\n"
GRID = AprilGrid(6, 6, 0.07, 0.3), ["board=target.yaml"]
MARKERS = (
    Charuco(10, 7, 0.052, 0.039, "5X5_100"),
    ["board=10x7", "square=0.052", "marker=0.039", "dictionary=5X5_100"],
)


def photographed(folder: Path, board: AnyBoard, cameras: int, moments: int) -> None:
    """Pictures ``{camera}/{moment}.png`` of a board all around fisheyes of 200° that look outwards, and its target."""
    drawing, rig = Drawing(board), back_to_back(cameras, 560)
    places = around(moments, drawing)
    for name, camera, from_world in zip(rig.names, rig.cameras.values(), rig.camera_from_world, strict=True):
        eye = Eye(camera)
        for moment, place in enumerate(places):
            picture = eye.picture(drawing, from_world @ place, noise=2.0, seed=moment)
            write_image(folder / f"{name}/{moment:03}.png", picture)
    (folder / "target.yaml").write_text(TARGET)


@pytest.mark.slow
@pytest.mark.parametrize(("cameras", "board"), [(2, GRID), (2, MARKERS), (4, MARKERS)])
def test_rigs_past_180_degrees_are_calibrated(
    run: Run, tmp_path: Path, cameras: int, board: tuple[AnyBoard, list[str]]
) -> None:
    """Focal lengths within 0.1 %, axes within 0.02° of each other, 0.15 px RMS with noise of two grey values."""
    photographed(tmp_path, board[0], cameras, 40)
    pattern = "images={camera}/*.png"
    printed = run("calibrate", pattern, *board[1], "to=fisheye", "field_of_view_deg=200", "output=rig.yaml")
    assert "cam1: axis 179" in printed or cameras == 4
    found, truth = read_rig(tmp_path / "rig.yaml", dtype=torch.float64), back_to_back(cameras, 560)
    assert float(printed.rsplit("RMS ", 1)[1].split()[0]) < 0.15
    for one, other in zip(found.cameras.values(), truth.cameras.values(), strict=True):
        assert isinstance(one, FisheyeCamera)
        assert isinstance(other, FisheyeCamera)
        torch.testing.assert_close(one.focal_length, other.focal_length, rtol=1e-3, atol=0)
        assert 1.6 < one.max_angle < 1.05 * 1.75  # what corners reach, and 5 % more
    axes = [rig.world_from_camera[:, :3, 2] @ rig.world_from_camera[0, :3, :3] for rig in (found, truth)]
    between = [angle_from_axis(axis).rad2deg() for axis in axes]
    torch.testing.assert_close(between[0], between[1], rtol=0, atol=0.02)


def test_the_worst_pictures_come_first(capsys: pytest.CaptureFixture[str]) -> None:
    rig = ring_rig(2, image_size=(64, 64))
    residuals = torch.zeros(3, 2, 8, 2)
    residuals[..., 1] = torch.tensor([[0.1, 0.5], [0.3, 0.2], [0.4, 0.0]])[..., None]
    labels = [{name: f"{name}-{moment}" for name in rig.names} for moment in "abc"]
    sizes = dict.fromkeys(rig.names, (64, 64))
    pictures = commands.Pictures(labels, sizes, 63 * torch.rand(3, 2, 8, 2), torch.ones(3, 2, 8).bool())
    commands._report(SimpleNamespace(residuals=residuals, rig=rig, rms_error=0.3), pictures)  # type: ignore[arg-type]
    printed = capsys.readouterr().out
    found = re.findall(r"(cam\d-\w).*(0\.\d{3})", printed)
    assert [name for name, _ in found] == ["cam2-a", "cam1-c", "cam1-b", "cam2-b", "cam1-a"]
    assert [rms for _, rms in found] == ["0.500", "0.400", "0.300", "0.200", "0.100"]
    assert "boards on 5 of 6" in printed
    assert "RMS 0.294 px of 24 corners" in printed  # √((0.1² + 0.3² + 0.4²) / 3)
    assert "8 of 48 corners left out" in printed
    assert "cam2-c left out" in printed


def test_boards_that_two_cameras_never_share_are_told(failing: Run, tmp_path: Path) -> None:
    for name, moments in (("front", range(4)), ("back", range(4, 8))):
        write_boards(tmp_path / name)
        for path in (tmp_path / name).glob("*.png"):
            if int(path.stem) not in moments:
                path.unlink()
    words = (f"board={COLUMNS}x{ROWS}", f"square={SQUARE}", "field_of_view_deg=130")
    message = failing("calibrate", f"images={tmp_path}/{{camera}}/*.png", *words)
    assert all(word in message for word in ("images: no view", "back", "front"))


def test_a_picture_whose_board_stands_elsewhere_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    board = grid_of(9, 6)
    pixels, seen = seen_by(truth(), board)
    labels = [{name: f"{name}/{moment}.png" for name in ("cam0", "cam1")} for moment in range(len(pixels))]
    pictures = commands.Pictures(labels, {"cam0": SIZE, "cam1": SIZE}, pixels, seen)
    commands._report(calibrated(board, pixels, seen), pictures)
    assert "Warning" not in capsys.readouterr().out
    pixels[2, 1] += 30
    commands._report(calibrated(board, pixels, seen), pictures)
    said = " ".join(capsys.readouterr().out.split())
    assert "Warning: cam1/2.png left out: the board stands elsewhere than in the others' pictures" in said


def test_a_lens_is_calibrated_from_pictures(run: Run, tmp_path: Path) -> None:
    write_boards(tmp_path / "board")
    words = typed(f"images=board/* board={COLUMNS}x{ROWS} square={SQUARE} num_coefficients=2")
    printed = run("calibrate", *words, "field_of_view_deg=130", "output=lens.yaml")
    assert "RMS" in printed
    assert "Warning" not in printed
    copy = min((tmp_path / "board").glob("*.png"))
    write_image(copy.with_suffix(".jpg"), read_image(copy))
    printed = " ".join(run("calibrate", *words, "field_of_view_deg=130", "output=lens.yaml").split())
    assert "Warning: 1 of " in printed
    assert f"{copy.stem}.jpg and board/{copy.name}: copies count twice" in printed
    camera = read_camera(tmp_path / "lens.yaml")
    assert isinstance(camera, KannalaBrandtCamera)
    pixels = TRUTH.pixel_grid()[40:200:20, 60:260:20].reshape(-1, 2)
    rays = TRUTH.unproject(pixels).directions
    assert (camera.project(rays).pixels - pixels).norm(dim=-1).max() < 0.6


def test_views_in_one_picture_or_video_are_those_of_their_cameras(
    failing: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pictures of each camera, both in one, a video of such, and one with two streams: the same corners."""
    pytest.importorskip("av")
    write_boards(tmp_path / "views[1]/back")
    pairs = []
    for number, path in enumerate(sorted((tmp_path / "views[1]/back").glob("*.png"))):
        if number > 3:
            path.unlink()
            continue
        back = (255 * read_image(path)).round().byte().movedim(0, -1).numpy()
        front = np.roll(back, number % 3 - 1, 1)
        write_image(tmp_path / f"views[1]/front/front_{path.name}", front)
        path.rename(path.with_stem(f"back_{path.stem}"))
        write_image(tmp_path / f"both/{path.name}", np.concatenate((back, front), 1))
        pairs.append((back, front))
    write_streams(tmp_path / "wide.mkv", [[np.concatenate(pair, 1) for pair in pairs]], "ffv1")
    write_streams(tmp_path / "streams.mkv", list(zip(*pairs, strict=True)), "ffv1")
    words = (f"board={COLUMNS}x{ROWS}", f"square={SQUARE}", "num_coefficients=2", "field_of_view_deg=130")
    found = []

    def stop(
        points: torch.Tensor, pixels: torch.Tensor, sizes: object, to: str, seen: object, **keys: object
    ) -> None:
        found.append((sizes, pixels, seen))
        raise ArgumentError("stop: boards are found")

    monkeypatch.setattr(commands, "calibrate_rig", stop)
    for images in ("views[1]/{camera}/{camera}_*.png", "both/*.png", "wide.mkv", "streams.mkv"):
        names = () if "{" in images else ("cameras=[back,front]",)
        assert "boards are found" in failing("calibrate", f"images={tmp_path}/{images}", *names, *words)
    assert list(found[0][0]) == ["back", "front"]
    assert found[0][2].any(-1).all()
    for sizes, pixels, seen in found[1:]:
        assert sizes == found[0][0]
        assert torch.equal(pixels, found[0][1])
        assert torch.equal(seen, found[0][2])
    message = failing("calibrate", f"images={tmp_path}/streams.mkv", *words)
    assert "has 2 video streams; name their cameras" in message
    message = failing("calibrate", f"images={tmp_path}/views[1]/{{camera}}/*.png", "cameras=[a,b]", *words)
    assert "cameras: they are those in one picture or video" in message
    message = failing("calibrate", f"images={tmp_path}/wide.mkv", "cameras=[a,b,c,d,e,f,g]", *words)
    assert "cameras: 7 views in rows and columns do not fill a picture of 640 x 240" in message


def test_a_picture_without_a_board_is_told(failing: Run, tmp_path: Path) -> None:
    write_image(tmp_path / "grey.png", torch.full((60, 80, 3), 128, dtype=torch.uint8).numpy())
    message = failing("calibrate", "board=9x6", "square=0.03", f"images={tmp_path}/grey.png")
    assert "found on 0 of 1 pictures" in message
