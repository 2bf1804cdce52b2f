# SPDX-License-Identifier: Apache-2.0
"""Poses in metres of UTM or of the earth: nothing depends on where a world's origin lies, and files hold that world."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from sphericalvision.cameras import (
    CameraRig,
    EquirectangularCamera,
    KannalaBrandtCamera,
    Trajectory,
    read_rig,
    ring_rig,
    save_rig,
)
from sphericalvision.cameras.calibration.save import rig_formats
from sphericalvision.capture import Predictor
from sphericalvision.capture.export import RigProgram, description
from sphericalvision.capture.fusing import FusedCloud
from sphericalvision.capture.outputs import Outputs
from sphericalvision.capture.points import SurfacePoints
from sphericalvision.capture.result import DepthImage
from sphericalvision.capture.result_folder import Settings
from sphericalvision.capture.splat import SplatScene
from sphericalvision.capture.writers import in_world
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.sphere import Equirectangular
from tests.worlds import ball

DOUBLE = torch.float64
PLACES = {
    "beside": torch.tensor([30_000.0, 5.0, -60_000.0], dtype=DOUBLE),
    "utm": torch.tensor([458_952.13, -110.4, 5_428_765.31], dtype=DOUBLE),
    "earth": torch.tensor([-2_694_045.7, -4_293_642.3, 3_857_878.9], dtype=DOUBLE),
}
far = pytest.mark.parametrize("place", PLACES)


def way(count: int = 5) -> torch.Tensor:
    """Poses ``(count, 4, 4)``, 13 cm from one to the next, that turn."""
    steps = torch.arange(count, dtype=DOUBLE)
    turns = torch.stack((0.1 * steps, 0.3 * steps, 0 * steps), -1)
    return transform_from_axis_angle(turns, torch.stack((0.13 * steps, 0.01 * steps, 0.02 * steps**2), -1))


def moved(poses: torch.Tensor, place: str) -> torch.Tensor:
    poses = poses.clone()
    poses[..., :3, 3] += PLACES[place]
    return poses


def ring_at(place: str) -> CameraRig:
    """Three cameras on their way, in float64, in which nothing has to be subtracted."""
    return CameraRig(ring_rig(3, image_size=(16, 16)).to(DOUBLE).cameras, moved(way(3), place))


def relative(rig: CameraRig) -> torch.Tensor:
    return (rig.positions - rig.center).double()


@far
@pytest.mark.parametrize("carrier", [EquirectangularCamera((16, 32)), ring_rig(2, image_size=(16, 16))])
def test_windows_of_a_trajectory(place: str, carrier: EquirectangularCamera | CameraRig) -> None:
    names = list("abcde")
    near = Trajectory(names, way()).rig(carrier, [1, 2, 4])
    there = Trajectory(names, moved(way(), place)).rig(carrier, [1, 2, 4])
    assert there.world_from_camera.dtype == torch.float32
    torch.testing.assert_close(relative(there), relative(near), rtol=0, atol=2e-6)
    torch.testing.assert_close(there.axes, near.axes)
    expected = near.positions.double() + PLACES[place]
    torch.testing.assert_close(there.in_world().positions, expected, rtol=0, atol=2e-6)
    assert not near.origin.any()
    assert near.in_world() is near


TURN = transform_from_axis_angle(torch.tensor([0.3, -1.0, 0.2]).double(), torch.zeros(3).double())[:3, :3]
CHANGES: dict[str, Callable[[CameraRig], CameraRig]] = {
    "to": lambda rig: rig.to(torch.float32),
    "subset": lambda rig: rig.subset([2, 0]),
    "permuted": lambda rig: rig.permuted([2, 0, 1]),
    "tilted": lambda rig: rig.rotated(tilt=0.3),
    "rotated": lambda rig: rig.rotated(rotation=TURN),
    "resized": lambda rig: rig.resized((8, 8)),
    "scaled": lambda rig: rig.scaled(1.5),
    "of a batch": lambda rig: CameraRig.stack([rig, rig.scaled(2)]).select(1),
    "rotated batch": lambda rig: CameraRig.stack([rig, rig]).rotated(rotation=TURN.expand(2, 3, 3)).select(0),
    "replaced": lambda rig: rig.replaced(masks={}),
}


@far
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_whatever_is_done_to_a_rig_its_world_stays(
    place: str, change: Callable[[CameraRig], CameraRig]
) -> None:
    """In float64 nothing has to be subtracted, which says what is right."""
    exact = ring_at(place)
    near = exact.to(torch.float32)
    assert not exact.origin.any()
    assert near.origin.any()
    result, expected = change(near), change(exact)
    torch.testing.assert_close(relative(result), relative(expected), rtol=0, atol=2e-6)
    torch.testing.assert_close(
        result.in_world().positions, expected.in_world().positions, rtol=1e-12, atol=4e-6
    )


@far
@pytest.mark.parametrize("name", rig_formats())
def test_files_hold_the_far_world(place: str, name: str, tmp_path: Path) -> None:
    """Formats of poses relative to one of the cameras lose the place, and no distance."""
    lens = KannalaBrandtCamera([9.0, 9.0], [7.5, 7.5], [0.0, 0.0, 0.0, 0.0], (16, 16), 1.2)
    if name in ("ocamcalib", "omnimvs", "multicol", "spires", "woodscape", "py_ocamcalib"):
        pytest.skip("of another lens; poses are written by the same function for all")
    number = 2 if name in ("opencv", "orbslam") else 3
    rig = CameraRig([lens] * number, moved(way(number), place)).to(torch.float32)
    path = tmp_path / "rig.yaml"
    save_rig(rig, path, name)
    again = read_rig(path, image_size=(16, 16))
    torch.testing.assert_close(again.baselines, rig.baselines, rtol=0, atol=1e-4)
    if again.in_world().center.norm() > 1000:
        torch.testing.assert_close(again.in_world().positions, rig.in_world().positions, rtol=0, atol=1e-4)
    else:
        assert name != "native"


@far
def test_a_fused_cloud_is_the_same_cloud_elsewhere(place: str) -> None:
    """Frames come from windows with an origin each; what is saved on the way is gone on with."""
    rays = Equirectangular(32, 64).directions.flatten(0, 1)
    ones = torch.ones(32, 64)
    centers = torch.tensor([[0.0, 0.0, 0.0], [0.4, 0.0, 0.1], [0.9, 0.1, 0.3], [1.2, 0.1, 0.3]]).double()
    where = PLACES[place]

    def fused(shift: torch.Tensor, folder: Path | None = None) -> FusedCloud:
        cloud = FusedCloud(0.3)
        for number, center in enumerate(centers):
            origin = (shift + center + 7.0 * number).round() if shift.any() else torch.zeros(3).double()
            start = (shift + center - origin).float()
            points = SurfacePoints(start + 4 * rays, rays.abs(), -rays, ones.flatten())
            cloud.add(str(number), points, DepthImage(4 * ones, ones, ones > 0), start, origin)
        return cloud

    # Cubes begin at whole metres in both worlds where the place is one.
    near, there = fused(torch.zeros(3).double()), fused(where.round())
    assert there.points().points.dtype == DOUBLE
    assert len(near.points().points) > 200
    shifted = there.points().points - where.round()
    distance = torch.cdist(near.points().points.double(), shifted).amin(1)
    assert (distance < 1e-3).double().mean() > 0.97  # rounding puts few points into another cube
    assert abs(len(shifted) - len(near.points().points)) < 0.03 * len(shifted)


def test_cubes_grow_until_a_way_fits(tmp_path: Path) -> None:
    rays = Equirectangular(16, 32).directions.flatten(0, 1)
    ones = torch.ones(16, 32)
    cloud = FusedCloud(0.05)
    for name, away in (("a", 0.0), ("b", 0.0), ("c", 90_000.0), ("d", 90_000.0), ("e", 90_000.0)):
        center = torch.tensor([away, 0.0, 0.0])
        points = SurfacePoints(rays + center, rays.abs(), -rays, ones.flatten())
        cloud.add(name, points, DepthImage(ones, ones, ones > 0), center)
    assert cloud.side == pytest.approx(0.2)
    assert (cloud.points().points[:, 0] > 80_000).sum() > 100
    cloud.save(tmp_path / "fused.npz")
    assert len(FusedCloud.load(tmp_path / "fused.npz").points().points) == len(cloud.points().points)


@far
def test_what_is_written_is_in_the_far_world(place: str, tmp_path: Path) -> None:
    rig = ring_at(place).to(torch.float32)
    depth = ball(rig, level=3, min_depth=0.55)
    outputs = Outputs(tmp_path, Settings(["cloud", "glb", "npz", "fused"], height=32))
    outputs.write("frame", depth)
    outputs.close()
    center = rig.in_world().center.numpy()
    program = RigProgram(Predictor(rig, method="semi_global", level=3, min_depth=0.5), "sphere")
    described = np.array([float(value) for value in description(program)["center"].split(", ")])
    np.testing.assert_allclose(described, center, rtol=0, atol=1e-5)
    radius = float(depth.depth.nanmedian())
    for path in tmp_path.rglob("*.ply"):
        points = trimesh.load(path).vertices
        assert np.abs(points.mean(0) - center).max() < 0.5 * radius, path
        steps = np.diff(np.unique(np.round(points[:, 0] - center[0], 4)))
        assert np.median(steps) < 0.05, path  # no steps of float32
    assert list(tmp_path.rglob("*.ply"))
    stored = np.load(next(tmp_path.rglob("*depth.npz")))
    np.testing.assert_allclose(stored["center"], center, rtol=0, atol=1e-5)
    for path in tmp_path.rglob("*.glb"):
        assert np.abs(trimesh.load(path).bounds).max() < 10 * radius, path
    scene = SplatScene(tmp_path / "splat")  # of which trainers take float32: all of it is near its own origin
    scene.add("0", depth)
    scene.close(in_world(depth.points(), rig.origin))
    cameras = read_rig(tmp_path / "splat/pinhole/transforms.json").positions.numpy()
    points = trimesh.load(tmp_path / "splat/pinhole/points3D.ply").vertices
    assert np.abs(points.mean(0) - cameras.mean(0)).max() < 0.5 * radius
