# SPDX-License-Identifier: Apache-2.0
"""What the room computes and writes, with defaults, of values that have no symmetry: one number each."""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import cv2
import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from sphericalvision.cameras import CameraRig, FisheyeCamera, PinholeCamera, ring_rig
from sphericalvision.capture import Depth, Hint, Predictor, find_own_body
from sphericalvision.capture.fusing import FusedCloud
from sphericalvision.capture.outputs import Outputs
from sphericalvision.capture.pinhole_twins import pinhole_twins
from sphericalvision.capture.preparation.dark_surround import dark_beyond
from sphericalvision.capture.result_folder import Settings
from sphericalvision.capture.sources.listings import listed_clock
from sphericalvision.capture.sources.moments import Clock, pair_moments
from sphericalvision.capture.sources.videos import _packets
from sphericalvision.capture.viewer import Timeline
from sphericalvision.capture.writers import OUTPUTS
from sphericalvision.core import MissingFileError
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.icosphere import icosphere_vertices
from sphericalvision.io.images import read_pages
from sphericalvision.models import SemiGlobalSweep, WinnerTakesAll
from sphericalvision.scenes import make_scene, render_rig
from sphericalvision.sphere import Views
from tests.laws.cameras import uneven_rig
from tests.values import coarse_sum, numbers_in, rand, sum_of, tensors_of, weighted_sum

RIG = uneven_rig().to(dtype=torch.float32)
MOTION = transform_from_axis_angle(torch.tensor([0.1, -0.3, 0.05]), torch.tensor([0.1, -0.05, 0.2]))
RAYS = 3 * rand(400, 3, seed=5).float() - 1.5
DISTANCES, TRUST = 2 * rand(400, seed=2).float(), rand(400).float()
DIRECTIONS = icosphere_vertices(3)
VIEW = PinholeCamera([20.0, 22.0], [9.0, 7.0], (15, 19))


@cache
def images(noise: float = 0.0, loss: float = 1.0, dark: float = 1.0) -> dict[str, Tensor]:
    """A room; noise, darkness and what the second camera has of its light on request."""
    result = {}
    for k, (name, image) in enumerate(render_rig(make_scene("room", seed=3), RIG, 2).items()):
        image = image * (loss if name == "b" else 1) + noise * (rand(*image.shape, seed=k) - 0.5).float()
        result[name] = dark * image.clamp(0, 1)
    return result


def batch(**options: float) -> dict[str, Tensor]:
    return {name: torch.stack((image, image.flip(-1).sqrt())) for name, image in images(**options).items()}


def depth(seed: int = 0, level: int = 3, rig: CameraRig = RIG) -> Depth:
    """Of an uneven surface around a rig, surer here and seen there."""
    net = WinnerTakesAll(level, 12, 0.4, depth_coarsening=0)
    x, y, z = net.grid.vertices.unbind(-1)
    noise = rand(len(x), seed=seed).float()
    index = 3 + 1.4 * (3 * x).sin() + y - 1.1 * (2 * z - x).cos() + 0.2 * noise
    return Depth(index, (0.5 + 0.4 * z + 0.3 * (noise - 0.5)).clamp(0, 1), noise > 0.1, net, rig, images())


def floor(tilt: float = 0.2) -> Depth:
    """A rough floor 1.2 m below a rig that leans, and a ball around it elsewhere."""
    net = WinnerTakesAll(4, 32, 0.3, depth_coarsening=0)
    down = net.grid.vertices @ torch.tensor([math.sin(tilt), math.cos(tilt), 0.1])
    noise = rand(len(down)).float()
    index = 31 * 0.3 * (down / 1.2).clamp(min=0.25) + 0.4 * (noise - 0.5)
    return Depth(index, 0.3 + 0.7 * noise.flip(0), noise > 0.05, net, RIG, {})


def hint(form: str) -> Hint:
    """Of images of depth, which are off by some noise where they are fitted."""
    noise = {name: rand(1, 36, 50, seed=k).float() for k, name in enumerate(RIG.names)}
    if form in ("range", "z"):
        return Hint.of_views(Views({name: 0.3 + 3 * n for name, n in noise.items()}, RIG), form, weight=0.7)  # type: ignore[arg-type]
    true = {name: depth().camera(name).depth.nan_to_num(0)[None] for name in RIG.names}
    if form == "affine":
        maps = {name: 3 / true[name] - 0.2 + 0.2 * n for name, n in noise.items()}
        return Hint.of_views(Views(maps, RIG), fit="affine")
    scaled = {name: 7 * true[name] + 0.5 * n for name, n in noise.items()}
    return Hint.of_views(Views(scaled, RIG), fit="scale")


def fused() -> FusedCloud:
    cloud = FusedCloud(0.3)
    for number in range(4):
        cloud.add(str(number), depth(number).points(), depth(number).panorama(24), RIG.center + 0.05 * number)
    return cloud


def carried() -> Depth:
    last = Hint.of_depth(depth(1), MOTION).averaged(depth(2))
    return Hint.of_depth(last, torch.linalg.inv(MOTION)).averaged(depth(3))


def body() -> Any:
    rig, frames = ring_rig(2, image_size=(60, 72)), []
    for seed in range(10):
        blobs = [cv2.GaussianBlur(rand(60, 72, seed=2 * seed + k).numpy(), (0, 0), 2) for k in range(2)]
        grey = [(3 * torch.from_numpy(blob) - 1).clamp(0, 1).float() for blob in blobs]
        frame = [image.expand(3, -1, -1).clone() for image in grey]
        frame[0][:, 42:, 16:56] = 0.1
        frames.append(dict(zip(rig.names, frame, strict=True)))
    return find_own_body(rig, frames, margin=2)


def surround() -> Any:
    lens = FisheyeCamera.from_field_of_view((120, 140), 3.6)
    angle = lens.unproject(lens.pixel_grid()).directions[..., 2].acos()
    return dark_beyond(lens, [torch.where(angle < 1.31, 0.2 + 0.5 * rand(3, 120, 140).float(), 0.02)])


def page() -> Any:
    timeline = Timeline(24, most_points=200)
    for number in range(2):
        timeline.add(str(number), depth(number, level=4), truth=1.1 * depth(level=4).depth)
    for frame in timeline._frames:
        yield np.frombuffer(base64.b64decode(frame["points"]), np.float32).copy()
        yield np.frombuffer(base64.b64decode(frame["colors"]), np.uint8) / 255
    yield timeline._radius, timeline._reach, timeline.near


def twins() -> Any:
    for camera in (*RIG.cameras.values(), FisheyeCamera.from_field_of_view((36, 50), 1.9)):
        for twin in pinhole_twins(camera):
            yield twin.pose, twin.camera, twin.remap(images()["a"])[:, ::3, ::3]


def predictor() -> Predictor:
    return Predictor(RIG, SemiGlobalSweep(3, 8, 0.5, 1), min_depth=0.5)


MODULES = "capture.alignment capture.checks capture.export capture.leveling capture.pseudo_labels "
MODULES += "capture.result capture.preparation.nearest capture.preparation.photometry capture.preparation.preparation"
"""Where names of the table come from, besides those that are public."""

NUMBERS = """
depth().information / 1e4, depth().inverse_depth, depth().max_depth, depth().share_seen -> -10.0739
near_end_of(depth()) -> 0.4322
depth().panorama(13), depth().panorama(13).measured, depth().camera("b"), depth().camera(VIEW, MOTION) -> -10007.1336
depth(level=4).points(0.4, 3.0) -> 16.6965
depth(level=4).points(voxel=0.3) -> -4.0601
depth(level=4).mesh(0.3, 3.0).vertices, depth(level=4).mesh(0.3, 3.0).faces / 100 -> -89.0359
fused().points() -> 6.7483
floor_up(floor()), leveling_turn([floor(), floor(0.3)])[0] -> -0.2886
Hint.of_points(RAYS, TRUST).on(depth().network.grid, RIG) -> 13.4943
Hint.of_directions(RAYS, DISTANCES, TRUST).on(depth().network.grid, RIG) -> -3.2370
[hint(form).on(depth().network.grid, RIG, depth()) for form in ("range", "z", "scale", "affine")] -> -7.9299
carried().index, carried().information / 1e4 -> 3.5128
pose_agreement(images(), RIG), camera_agreement(depth(level=4)), PhotoConsistency(4)(depth(level=4)) -> -0.9242
Photometer(RIG).estimate(images(loss=0.6)) -> -1.4105
Photometer(RIG).estimate(images(loss=0.6)).light(rand(3, 7).float()) -> 0.7122
Compensator(RIG).smoothed(batch(noise=0.3)) -> -5.8041
Compensator(RIG, Intake(RIG, Icosphere(2)).averaged).smoothed(batch(noise=0.3)) -> 2.6502
Compensator(RIG).brightened(batch(dark=0.15)) -> -9.3910
compensated(RIG, images(noise=0.2, loss=0.5)) -> -1.8858
30 * _noise(rand(2, 3, 40, 30), rand(40, 30, seed=3) > 0.5) -> 1.0675
NearestHypothesis(None).in_frames([images()], RIG) -> 0.2335
body() -> -2.8559
surround() -> 0.7073
align_rig_direct(RIG, images(), DIRECTIONS, 0.4 + 0.3 * DIRECTIONS[:, 0], rand(642).float(), pixel=0.05) -> -111.0646
[(v.turns, v.spread, v.agreement) for v in [_estimated([depth(level=4)])]] -> 0.8266
_observability(RIG.subset(["a", "c"])) -> 0.0304
PseudoLabeller(SemiGlobalSweep(4, 8, 0.5), RIG)(images()) -> -5519.6828
page() -> 3.7389
twins() -> 69.5240
RigProgram(predictor())(torch.stack(list(images().values()))[None]) -> 4.4052
RigProgram(predictor(), height=9)(torch.stack(list(images().values()))[None]) -> 10.2350
predictor().inputs(images(loss=0.5))[0] -> -7.8657
"""
"""A call -> the sum over the numbers in its result, each weighted by where it stands."""


@pytest.mark.parametrize(("call", "expected"), numbers_in(NUMBERS))
def test_numbers_stay(call: str, expected: float) -> None:
    assert sum_of(call, globals(), MODULES) == pytest.approx(expected, abs=2e-3)


def test_cameras_that_never_meet_are_not_paired_by_names() -> None:
    """The last clock counts whatever it says."""
    images = {camera: {"0": camera, "1": camera} for camera in "ab"}
    apart = Clock("stamps", {"a": {"0": 0.0, "1": 0.1}, "b": {"0": 5.0, "1": 5.1}})
    with pytest.raises(MissingFileError):
        pair_moments(images, [apart])
    headers = Clock("headers", {camera: {"0": 0.0, "1": 1.0} for camera in "ab"})
    assert pair_moments(images, [apart, headers]).clock == 1


def test_the_table_in_the_folder_of_images_counts_and_not_the_one_above_it(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    for path, begin in ((tmp_path / "a/times.csv", 5.0), (tmp_path / "times.csv", 7.0)):
        path.write_text(f"frame,time\n0,{begin}\n1,{begin + 0.1}\n")
    clock = listed_clock({"a": tmp_path / "a"}, {"a": "a"}, {"a": {"0": "0", "1": "1"}})
    assert clock is not None
    assert list(clock.times["a"].values()) == [5.0, 5.1]


def test_a_video_ends_where_it_cannot_be_read_any_more() -> None:
    def packets(_: Any) -> Iterator[int]:
        yield from range(3)
        raise av.FFmpegError(1, "damaged")

    assert list(_packets(SimpleNamespace(demux=packets), None)) == [0, 1, 2]


def content_of(path: Path) -> float:
    """What a reader of another library finds in a file."""
    if path.suffix == ".png":
        values = np.atleast_3d(read_pages(path)[0]).transpose(2, 0, 1)
        return coarse_sum(torch.from_numpy(values / (1000 if "depth/" in str(path) else 255)))
    if path.suffix in (".ply", ".glb"):
        scene = trimesh.load(path, process=False)
        (shape,) = scene.geometry.values() if isinstance(scene, trimesh.Scene) else (scene,)
        colors = np.asarray(shape.colors if hasattr(shape, "colors") else shape.visual.vertex_colors)[:, :3]
        return weighted_sum(torch.from_numpy(np.array(shape.vertices)), torch.from_numpy(colors / 255))
    if path.suffix == ".npz":
        arrays = [values for _, values in sorted(np.load(path).items()) if values.dtype.kind in "fb"]
        return weighted_sum(*tensors_of(arrays))
    if path.suffix == ".mp4":
        with av.open(str(path)) as video:
            frames = [torch.from_numpy(frame.to_ndarray(format="rgb24")) for frame in video.decode(video=0)]
            rate = float(video.streams.video[0].average_rate)
            return rate + coarse_sum(*(frame.movedim(-1, 0) / 255.0 for frame in frames))
    if path.suffix == ".html":
        encoded = re.findall(r"image/jpeg;base64,([^\"]+)", path.read_text())
        pictures = [cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), 1) for text in encoded]
        return coarse_sum(*(torch.from_numpy(picture).movedim(-1, 0) / 255.0 for picture in pictures))
    lines = path.read_text().splitlines()[1:] if path.suffix == ".csv" else []
    return sum(float(line.rpartition(",")[2]) for line in lines)


FILES: dict[str, float] = {
    "panorama": 0.792,
    "panorama_video": 7.031,
    "depth": -13.032,
    "confidence": -4.277,
    "cloud": 71.653,
    "glb": 13.197,
    "mesh": -58.322,
    "viewer": 0.342,
    "npz": 25497.916,
    "video": 6.146,
    "timeline": -2.798,
    "consistency": 0.743,
    "fused": -30.849,
    "splat": -55.662,
}
"""Output -> the sum over the contents of its files."""


@pytest.mark.parametrize("output", [name for name in OUTPUTS if name != "rerun"])
def test_contents_of_files_stay(output: str, tmp_path: Path) -> None:
    """Of a rig far from the origin, in axes of a robot."""
    axes = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    outputs = Outputs(tmp_path, Settings([output], 24, 0.3, rate=7.0, axes=axes))
    rig = RIG.replaced(origin=torch.tensor([100.0, -20, 30]).double())
    for number in range(3):
        outputs.write(str(number), depth(number, rig=rig))
    outputs.close()
    contents = (content_of(path) for path in sorted(tmp_path.rglob("*")) if path.is_file())
    assert sum(contents) == pytest.approx(FILES[output], abs=0.05)
