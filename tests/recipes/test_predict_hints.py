# SPDX-License-Identifier: Apache-2.0
"""``sphericalvision-predict hint=...``: files of each kind, the last frame, and what is refused."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from sphericalvision.cameras import ring_rig
from sphericalvision.capture import Depth
from sphericalvision.capture.alignment import RigTurns
from sphericalvision.capture.estimating import estimate_frames
from sphericalvision.capture.hints import CarriedDepth
from sphericalvision.capture.sources.frames import Selection
from sphericalvision.capture.sources.opening import open_source
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.icosphere import Icosphere
from sphericalvision.io.images import write_image, write_pages
from sphericalvision.models import WinnerTakesAll
from sphericalvision.recipes.commands import predict as commands
from sphericalvision.scenes import ray_depth, render_rig
from sphericalvision.sphere import Equirectangular
from tests.capture.test_hints import SCENE, depth_images
from tests.recipes.tiny import Run, typed

SIZE = (120, 120)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames 0 and 1 of a room, the second 10 cm on, and true depth of the first as everybody writes it."""
    folder = tmp_path_factory.mktemp("hints")
    rig = ring_rig(4, image_size=SIZE)
    rig.to_yaml(folder / "rig.yaml")
    poses = []
    for frame in range(4):
        moved = rig.world_from_camera.clone()
        moved[:, 2, 3] += 0.1 * frame
        poses.append(f"{frame} 0 0 {0.1 * frame} 0 0 0 1")
        for name, image in render_rig(SCENE, rig.replaced(world_from_camera=moved), 1).items():
            write_image(folder / f"{name}/{frame}.png", image)
    (folder / "poses.txt").write_text("\n".join(poses))
    points = (ray_depth(SCENE, rig.center, Icosphere(5).vertices)[:, None] * Icosphere(5).vertices).numpy()
    trimesh.PointCloud(points).export(folder / "0.ply")
    np.save(folder / "0.npy", points)
    for name, (depth,) in depth_images(rig.resized((80, 80))).items():
        write_pages(folder / f"mm/{name}/0.png", [(1000 * depth).numpy().astype(np.uint16)])
        inverse = 3 / depth.where(depth > 0, torch.inf) + 1
        write_pages(folder / f"mono/{name}/0.tiff", [inverse.where(depth > 0, torch.nan).numpy()])
    grid = Equirectangular(64, 128)
    panorama = ray_depth(SCENE, rig.center, grid.directions.reshape(-1, 3)).view(64, 128)
    write_pages(folder / "panorama0.tiff", [panorama.numpy()])
    np.savez(folder / "bad0.npz", depth=np.ones(5))
    return folder


def words(capture: Path, output: str, frames: str = "[0]") -> tuple[str, ...]:
    images = f"calibration={capture}/rig.yaml images={capture}/{{camera}}/{{frame}}.png frames={frames}"
    options = "level=5 min_depth=0.55 outputs=[npz] height=32 device=cpu align=false"
    return typed(f"{images} {options} output={output}")


def error(path: Path) -> float:
    """Mean error of the inverse depth of the first frame."""
    with np.load(path) as arrays:
        inverse_depth, directions = (torch.from_numpy(arrays[key]) for key in ("inverse_depth", "directions"))
        center = torch.from_numpy(arrays["center"]).float()
    return float((inverse_depth - 1 / ray_depth(SCENE, center, directions)).abs().mean())


def test_hints_of_each_kind_of_file(run: Run, capture: Path, tmp_path: Path) -> None:
    run("predict", *words(capture, "none"))
    plain = error(tmp_path / "none/0_depth.npz")
    kinds: dict[str, list[str]] = {
        "ply": [f"hint={capture}/{{frame}}.ply"],
        "npy": [f"hint={capture}/{{frame}}.npy", "hint_fit=scale"],
        "mm": [f"hint={capture}/mm/{{camera}}/{{frame}}.png"],
        "mono": [f"hint={capture}/mono/{{camera}}/{{frame}}.tiff", "hint_fit=affine"],
        "panorama": [f"hint={capture}/panorama{{frame}}.tiff"],
    }
    for name, given in kinds.items():
        run("predict", *words(capture, name), *given)
        assert error(tmp_path / f"{name}/0_depth.npz") < 0.85 * plain, name
    run("predict", *words(capture, "again"), f"hint={tmp_path}/ply/{{frame}}_depth.npz")
    assert error(tmp_path / "again/0_depth.npz") < plain


def test_depth_images_belong_to_the_cameras_that_the_whole_rig_says(
    run: Run, capture: Path, tmp_path: Path
) -> None:
    """Folders 0 to 3: of cam2 and cam3 alone, 2 and 3 are those of the cameras behind them."""
    for place, (name, (depth,)) in enumerate(depth_images(ring_rig(4, image_size=(40, 40))).items()):
        write_pages(tmp_path / f"depth/{place}/0.tiff", [depth.numpy()])
        write_pages(tmp_path / f"named/{name}/0.tiff", [depth.numpy()])
    for name in ("depth", "named"):
        given = [f"hint={tmp_path}/{name}/{{camera}}/{{frame}}.tiff", "cameras=[cam2,cam3]"]
        run("predict", *words(capture, f"out_{name}"), *given)
    counted, named = (error(tmp_path / f"out_{name}/0_depth.npz") for name in ("depth", "named"))
    assert counted == named


def test_depth_images_are_turned_as_their_cameras_are(
    run: Run, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = ring_rig(4, image_size=SIZE)
    poses = rig.world_from_camera.clone()
    poses[1] = poses[1] @ transform_from_axis_angle(torch.tensor([0.1, 0.0, 0.0]), torch.zeros(3))
    rig.replaced(world_from_camera=poses).to_yaml(tmp_path / "knocked.yaml")
    verdict = RigTurns(rig, torch.zeros(4, 3), torch.zeros(4), ("cam2",))
    monkeypatch.setattr(commands, "align_rig", lambda predictor, frames: verdict)
    hint = f"hint={capture}/mm/{{camera}}/{{frame}}.png"
    run("predict", *words(capture, "right"), hint)
    run("predict", *words(capture, "turned"), hint, f"calibration={tmp_path}/knocked.yaml", "align=true")
    right, turned = (error(tmp_path / f"{name}/0_depth.npz") for name in ("right", "turned"))
    assert turned == pytest.approx(right, rel=1e-4)


def test_hints_of_other_frames_or_kinds_are_refused(failing: Run, capture: Path) -> None:
    def message(*given: str, frames: str = "[0]") -> str:
        return failing("predict", *words(capture, "out", frames), *given)

    assert "give poses=, or leave hint out" in message("hint=last")
    assert "/1.ply: no such file" in message(f"hint={capture}/{{frame}}.ply", frames="[1]")
    assert "SemiGlobalSweep takes none" in message(f"hint={capture}/{{frame}}.ply", "method=semi_global")
    assert "twice as wide as high" in message(f"hint={capture}/mm/cam1/{{frame}}.png")
    assert "hint_fit: affine is for images" in message(f"hint={capture}/{{frame}}.ply", "hint_fit=affine")
    assert "they do not hold it" in message(f"hint={capture}/{{camera}}/{{frame}}.png")
    assert "expected directions, inverse_depth" in message(f"hint={capture}/bad{{frame}}.npz")
    assert "there are 2 frames" in message(f"hint={capture}/0.ply", frames="[0,1]")
    posed = [f"poses={capture}/poses.txt", "window=2", "up=-y"]
    for key in ("hint_fit=scale", "hint_quantity=z"):
        told = message("hint=last", key, *posed, frames="null")
        assert f"{key.partition('=')[0]}: is for hints in files" in told
    assert "hint_quantity: z is for depth images of cameras" in message(
        f"hint={capture}/{{frame}}.ply", "hint_quantity=z"
    )
    assert "not of windows with poses=" in message(f"hint={capture}/{{frame}}.ply", *posed, frames="null")


def test_frames_whose_hints_say_nothing_are_left_out(failing: Run, capture: Path, tmp_path: Path) -> None:
    """A scan without a point, images without a depth, and depth of another place that fits by no factor."""
    (tmp_path / "hints").mkdir()
    points = np.load(capture / "0.npy")
    np.save(tmp_path / "hints/0.npy", points)
    np.save(tmp_path / "hints/1.npy", np.full((5, 3), np.nan))
    generator = np.random.default_rng(0)
    np.save(tmp_path / "hints/2.npy", points * np.exp(generator.normal(0, 3, (len(points), 1))))
    for name, (depth,) in depth_images(ring_rig(4, image_size=(20, 20))).items():
        for frame in range(2):
            write_pages(tmp_path / f"hints/{name}/{frame}.tiff", [(depth * (1 - frame)).numpy()])
    given = [f"hint={tmp_path}/hints/{{frame}}.npy", "hint_fit=scale"]
    message = failing("predict", *words(capture, "points", "[0,1,2]"), *given)
    assert "2 of 3 frames were left out" in message
    assert "hints/1.npy: it has no valid depth" in message
    message = failing("predict", *words(capture, "far", "[0,2]"), *given)
    assert "frame 2, hint: no view of it agrees with the network's own depth" in message
    given = [f"hint={tmp_path}/hints/{{camera}}/{{frame}}.tiff"]
    message = failing("predict", *words(capture, "images", "[0,1]"), *given)
    assert "hints/cam1/1.tiff and those of the other cameras: it has no valid depth" in message
    for name in ("points", "far", "images"):
        assert [path.name for path in (tmp_path / name).glob("*.npz")] == ["0_depth.npz"]


def test_the_last_frame_as_a_hint_goes_by_the_poses(run: Run, capture: Path, tmp_path: Path) -> None:
    for name, given in {"none": [], "last": ["hint=last"]}.items():
        posed = [f"poses={capture}/poses.txt", "window=2", "spacing=0.05", *given]
        run("predict", *words(capture, name, "null"), *posed)
    files = [sorted((tmp_path / name).glob("*.npz")) for name in ("none", "last")]
    assert len(files[0]) == len(files[1]) >= 2
    plain, carried = ([error(path) for path in paths] for paths in files)
    assert carried[0] == plain[0]  # there is no frame before
    assert carried[1] != plain[1]
    assert carried[1] < 1.1 * plain[1]
    files[1][-1].unlink()
    run("predict", *words(capture, "last", "null"), *posed, "skip_existing=true")
    assert error(files[1][-1]) == carried[-1]  # a continuation goes on with the frames before


def test_what_is_carried_on_is_of_the_frames_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A continuation looks at the first frame for its colours, which is not the one before the next that is left."""
    for frame in range(30):
        for name in ("cam1", "cam2"):
            write_image(tmp_path / f"{name}/{frame}.png", torch.zeros(3, 8, 8))
    rig = ring_rig(2, image_size=(8, 8))
    net, ones = WinnerTakesAll(3, 16, depth_coarsening=0), torch.ones(642)
    carried: list[float | None] = []

    class Answers(SimpleNamespace):
        """Depth whose index is the number of the answer."""

        def __call__(self, images: object) -> Depth:
            carried.append(None)
            return Depth((len(carried) - 1) * ones, ones, ones > 0, net, rig, {})

    def averaged(before: CarriedDepth, depth: Depth) -> Depth:
        carried[-1] = float(before.depth.index[0])
        return depth

    monkeypatch.setattr(CarriedDepth, "averaged", averaged)

    source = open_source(f"{tmp_path}/{{camera}}/{{frame}}.png", rig)
    predictor: Any = Answers(device=torch.device("cpu"))
    done = estimate_frames(source, Selection(), predictor, {"0", "25"}.__contains__, hints="last")
    assert [estimate.frame.name for estimate in done if estimate.depth is not None] == ["0", "25"]
    assert carried == [None, None, *range(1, 11)]  # of frames 0 and 15 to 25
