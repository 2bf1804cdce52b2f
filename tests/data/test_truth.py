# SPDX-License-Identifier: Apache-2.0
"""Depth of scanned points: against the exact depth of rendered scenes, and the files that points are read from."""

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from sphericalvision.cameras import FisheyeCamera, ring_rig
from sphericalvision.core import FileFormatError
from sphericalvision.data import read_points, truth_from_points
from sphericalvision.data.scanned.scanned_frames import ScannedFrames
from sphericalvision.data.truth import _pixels_of, _rays_of
from sphericalvision.icosphere import Icosphere
from sphericalvision.io.images import write_image
from sphericalvision.scenes import Scene, make_scene, ray_depth
from sphericalvision.sphere import Equirectangular
from tests.values import weighted_sum

SCANNER = torch.tensor([0.15, -0.35, -0.1])
"""Where the LiDAR stands, beside and above the rig's centre."""


def lidar(lines: int = 128, columns: int = 1024, reach: float = 45.0) -> Tensor:
    """Rays of a spinning LiDAR: so many lines of latitude, up to ``reach`` degrees up and down."""
    elevation = torch.linspace(-math.radians(reach), math.radians(reach), lines)[:, None]
    azimuth = (torch.arange(columns) * 2 * math.pi / columns)[None]
    rays = (
        elevation.cos() * azimuth.sin(),
        -elevation.sin().expand(-1, columns),
        elevation.cos() * azimuth.cos(),
    )
    return torch.stack(rays, -1).reshape(-1, 3)


def scan(scene: Scene, where: Tensor = SCANNER, most: float = 80.0, rays: Tensor | None = None) -> Tensor:
    """Points of what a LiDAR sees."""
    rays = lidar() if rays is None else rays
    depth = ray_depth(scene, where, rays)
    hit = depth.isfinite() & (depth < most)
    return where + rays[hit] * depth[hit, None]


@pytest.mark.parametrize("kind", ["room", "outdoors", "hall"])
@pytest.mark.parametrize(
    "onto", [Equirectangular(160, 320), FisheyeCamera.from_field_of_view((180, 220), math.radians(200))]
)
def test_what_is_kept_is_right_and_most_of_what_is_seen_is_kept(kind: str, onto: object) -> None:
    scene = make_scene(kind, seed=3)
    points = scan(scene)
    truth = truth_from_points(points, onto)
    depth, valid = truth.depth.flatten(), truth.valid.flatten()
    exact = ray_depth(scene, torch.zeros(3), _rays_of(onto)[0].float())
    assert ((depth / exact - 1).abs() < 0.01)[valid].float().mean() >= 0.995

    distance = points.norm(dim=-1)
    visible = (ray_depth(scene, torch.zeros(3), points / distance[:, None]) / distance - 1).abs() < 0.005
    assert 1 - visible.float().mean() > 0.01  # there is something to remove
    pixels = _pixels_of(onto, points.double() / distance[:, None])
    seen = torch.zeros(len(valid), dtype=torch.bool)
    seen[pixels[visible & (pixels >= 0)]] = True
    assert (valid & seen).sum() / seen.sum() >= 0.8


@pytest.mark.parametrize(
    ("onto", "options", "number", "expected"),
    [
        (Equirectangular(20, 40), {}, 377, -12.50534),
        (FisheyeCamera.from_field_of_view((24, 31), 3.3), {}, 304, 20.15548),
        (Equirectangular(20, 40), {"gap": 0.05, "tolerance": 0.03, "noise": 0.02}, 406, -0.01721),
    ],
    ids=str,
)
def test_a_ball_in_a_box_beside_the_scanner(
    onto: Any, options: dict[str, float], number: int, expected: float
) -> None:
    """How many pixels are known, and a sum of their depth, around a place that neither box nor scanner has."""
    rays = lidar(64, 300).double()
    walls = ((torch.tensor([2.0, 1.2, 3.0]) - rays.sign() * SCANNER) / rays.abs()).amin(1)
    center = torch.tensor([0.9, 0.1, 1.3]).double() - SCANNER
    along = rays @ center
    root = along.square() + 0.35**2 - center.square().sum()
    depth = walls.where((root < 0) | (along < 0), along - root.clamp(min=0).sqrt())
    truth = truth_from_points(SCANNER + depth[:, None] * rays, onto, (0.1, -0.2, 0.15), **options)
    assert int(truth.valid.sum()) == number
    assert weighted_sum(truth.depth) == pytest.approx(expected, abs=1e-3)


def test_a_wall_behind_a_wall_is_hidden_and_a_slanted_floor_is_not() -> None:
    u, v = torch.meshgrid(torch.linspace(-1, 1, 200), torch.linspace(-1, 1, 200), indexing="ij")
    near = torch.stack((0.5 * u, 0.5 * v, 0 * u + 1.0), -1).reshape(-1, 3)
    far = torch.stack((3 * u, 3 * v, 0 * u + 3.0), -1).reshape(-1, 3) * 1.001
    camera = FisheyeCamera.from_field_of_view((61, 61), math.radians(80))
    both, alone = truth_from_points(torch.cat((near, far)), camera), truth_from_points(far, camera)
    assert abs(both.depth[30, 30] - 1) < 1e-3
    assert abs(alone.depth[30, 30] - 3.003) < 1e-3
    z = both.depth * camera.unproject(camera.pixel_grid()).directions[..., 2]
    assert ((z - 1).abs() < 0.01)[both.valid & (z < 2)].all()

    x, z = torch.meshgrid(torch.linspace(-4, 4, 400), torch.linspace(1, 8, 400), indexing="ij")
    floor = truth_from_points(torch.stack((x, 0 * x + 0.5, z), -1).reshape(-1, 3), camera, gap=0.03)
    down = floor.depth * camera.unproject(camera.pixel_grid()).directions[..., 1]
    assert floor.valid[35:45, 30].all()
    assert (down[floor.valid] - 0.5).abs().max() < 0.005


def test_truth_is_as_the_centre_says() -> None:
    grid, center = Icosphere(3), torch.tensor([1.0, 2.0, 3.0])
    around = 2.0 * Icosphere(5).vertices + center
    assert torch.allclose(truth_from_points(around, grid, center).depth, torch.tensor(2.0), atol=0.02)


def ply(kind: str, count: int) -> bytes:
    """One vertex, of which the header declares ``count``."""
    axes = "".join(f"property {kind} {axis}\n" for axis in "xyz")
    return f"ply\nformat ascii 1.0\nelement vertex {count}\n{axes}end_header\n1 2 3\n".encode()


def write_pcd(path: Path, points: np.ndarray, kind: str) -> None:
    """A file as PCL writes it, with more fields than are wanted."""
    head = "# .PCD\nVERSION 0.7\nFIELDS pair x y z ring\nSIZE 4 4 4 4 2\nTYPE F F F F U\nCOUNT 2 1 1 1 1\n"
    head += f"WIDTH 1\nHEIGHT {len(points)}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA {kind}\n"
    fields = [("pair", "<f4", 2), *((name, "<f4") for name in "xyz"), ("ring", "<u2")]
    table = np.zeros(len(points), fields)
    table["x"], table["y"], table["z"] = points.T
    body = (
        table.tobytes()
        if kind != "ascii"
        else "".join(f"0.5 0.5 {x} {y} {z} 3\n" for x, y, z in points).encode()
    )
    path.write_bytes(head.encode() + body)


def test_points_are_read_from_every_format(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)
    write_pcd(tmp_path / "a.pcd", points, "ascii")
    write_pcd(tmp_path / "b.pcd", points, "binary")
    np.hstack((points, points[:, :1])).tofile(tmp_path / "c.bin")
    np.save(tmp_path / "d.npy", np.vstack((points, np.full((1, 3), np.nan))))
    trimesh.PointCloud(points).export(tmp_path / "e.ply")
    (tmp_path / "f.csv").write_text(
        "time stamp [s];Y [m];Z;X\n" + "".join(f"17;{y};{z};{x}\n" for x, y, z in points.tolist())
    )
    (tmp_path / "g.csv").write_text("".join(f"{x},{y},{z},9\n" for x, y, z in points.tolist()))
    (tmp_path / "h.xyz").write_text(
        "//X Y Z\n# scanned\n" + "".join(f"{x} {y} {z} 9\n" for x, y, z in points.tolist())
    )
    (tmp_path / "i.xyz").write_text("7\n" + "".join(f"{x} {y} {z} 9\n" for x, y, z in points.tolist()))
    for name in ("a.pcd", "b.pcd", "c.bin", "d.npy", "e.ply", "f.csv", "g.csv", "h.xyz", "i.xyz"):
        assert np.allclose(read_points(tmp_path / name), points, atol=1e-6), name


def rows_of_a_scan(columns: int, number: int = 400) -> np.ndarray:
    """Points of a scanner with reflectance and, as fifth, ring."""
    random = np.random.default_rng(1)
    places = random.uniform((-40, -40, -2), (40, 40, 4), (number, 3))
    values = [places, random.integers(0, 256, (number, columns - 3))]
    return np.concatenate(values, 1)


@pytest.mark.parametrize(
    ("name", "content", "columns"),
    [
        ("kitti.bin", rows_of_a_scan(4).astype("<f4"), None),
        ("sweep.pcd.bin", rows_of_a_scan(5).astype("<f4"), None),
        ("five.bin", rows_of_a_scan(5).astype("<f4"), 5),
        ("three.bin", rows_of_a_scan(3).astype("<f4"), 3),
        ("unit.bin", (rows_of_a_scan(4) / np.array((1, 1, 1, 255))).astype("<f4"), None),
        ("signed.bin", (rows_of_a_scan(4) - np.array((0, 0, 0, 100))).astype("<f4"), None),
        ("grid.npy", rows_of_a_scan(3) + np.array((4.5e5, 5.4e6, 60.0)), None),  # UTM
        ("wide.npy", rows_of_a_scan(16), None),
        ("named.npy", np.rec.fromarrays(rows_of_a_scan(4).T[[3, 0, 1, 2]], names="intensity,x,y,z"), None),
    ],
)
def test_points_are_those_that_were_written(
    tmp_path: Path, name: str, content: np.ndarray, columns: int | None
) -> None:
    np.save(tmp_path / name, content) if name.endswith(".npy") else content.tofile(tmp_path / name)
    stored = np.stack([content[axis] for axis in "xyz"], 1) if content.dtype.names else content[:, :3]
    points = read_points(tmp_path / name, columns=columns)
    assert np.array_equal(points.numpy(), stored)  # of float64 files, too: to the last bit
    assert points.dtype == (torch.float32 if name.endswith(".bin") else torch.float64)


@pytest.mark.parametrize(
    ("name", "content", "remedy"),
    [
        ("five.bin", rows_of_a_scan(5).astype("<f4"), "columns="),
        ("doubles.bin", rows_of_a_scan(3), "columns="),
        ("bare.bin", rows_of_a_scan(3).astype("<f4"), "columns="),
        ("six.bin", rows_of_a_scan(6).astype("<f4"), "columns="),
        ("odd.bin", rows_of_a_scan(5, 401).astype("<f4"), "columns="),
        ("lying.npy", rows_of_a_scan(3).T, "transpose"),
        ("astray.npy", rows_of_a_scan(3) * 1e6, "metres"),
        ("millimetres.npy", (rows_of_a_scan(3) * 1000).astype(np.int32), "1000"),
    ],
)
def test_arrays_that_are_no_scans_are_refused(
    tmp_path: Path, name: str, content: np.ndarray, remedy: str
) -> None:
    np.save(tmp_path / name, content) if name.endswith(".npy") else content.tofile(tmp_path / name)
    with pytest.raises(FileFormatError, match=rf"{name}.*{remedy}"):
        read_points(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "head"),
    [
        ("a.xyz", "# units: mm\n"),
        ("a.csv", "// positions in millimetres\nx,y,z\n"),
        (
            "A.PLY",
            "ply\nformat ascii 1.0\nobj_info units = mm\nelement vertex 1\n"
            + "".join(f"property float {axis}\n" for axis in "xyz")
            + "end_header\n",
        ),
    ],
)
def test_a_cloud_whose_comment_says_another_unit_is_asked_about(tmp_path: Path, name: str, head: str) -> None:
    (tmp_path / name).write_text(f"{head}1000{',' if '.csv' in name else ' '}2 3\n".replace(",2 3", ",2,3"))
    with pytest.warns(UserWarning, match=rf"{name}, line \d: expected metres"):
        assert read_points(tmp_path / name).tolist() == [[1000, 2, 3]]


@pytest.mark.parametrize(("unit", "is_told"), [(1.0, False), (1000.0, True)])
def test_a_scan_as_wide_as_no_scanner_sees_is_asked_about(tmp_path: Path, unit: float, is_told: bool) -> None:
    strays = 1e5 * (np.arange(400)[:, None] < 3)  # do not count
    np.save(tmp_path / "room.npy", rows_of_a_scan(3) * unit + strays + np.array((4.5e5, 5.4e6, 60.0)))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read_points(tmp_path / "room.npy")
    assert ["millimetres" in str(warning.message) for warning in caught] == [True] * is_told


def test_files_that_hold_no_points_are_refused_by_name(tmp_path: Path) -> None:
    write_pcd(tmp_path / "packed.pcd", np.ones((2, 3)), "binary_compressed")
    with pytest.raises(FileFormatError, match="binary_compressed"):
        read_points(tmp_path / "packed.pcd")
    whole = tmp_path / "whole.pcd"
    write_pcd(whole, np.ones((2, 3)), "binary")
    write_pcd(tmp_path / "text.pcd", np.ones((2, 3), int), "ascii")
    named = tmp_path / "named.npy"
    np.save(named, np.ones(2, [("x", "f4"), ("y", "f4")]))
    for name, content in {
        "cut.pcd": whole.read_bytes()[:-5],
        "head.pcd": b"VERSION 0.7\n",
        "flat.npy": b"no array",
        "x.las": b"",
        "commas.xyz": b"1,5 2,5 3,5\n",
        "degrees.csv": b"lon,lat,height\n1,2,3\n",
        "millimetres.csv": b"x [mm],y [mm],z [mm]\n1,2,3\n",
        "millimetres.xyz": b"# x[mm] y[mm] z[mm]\n1 2 3\n",
        "millimetres.pcd": whole.read_bytes().replace(b"TYPE F F F F", b"TYPE F I I I"),
        "text.pcd": (tmp_path / "text.pcd").read_bytes().replace(b"TYPE F F F F", b"TYPE F I I I"),
        "short.csv": b"1,2\n",
        "fewer.xyz": b"3\n1 2 3\n",
        "cut.ply": ply("float", 2_000_000_000),
        "millimetres.ply": ply("int", 1),
        "flat.ply": ply("float", 1).replace(b" z", b" w"),
        "faces.ply": ply("float", 1).replace(b"vertex", b"face"),
        "flat.pcd": whole.read_bytes().replace(b" z", b" w"),
        "named.npy": named.read_bytes(),
        "utf16.csv": "x,y,z\n1,2,3\n".encode("utf-16-le"),
    }.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FileFormatError, match=name) as told:
            read_points(tmp_path / name)
        assert "Error" not in str(told.value)


def test_a_pcd_whose_viewpoint_is_a_pose_is_refused_unless_it_is_known_to_be_applied(tmp_path: Path) -> None:
    """Some programs move the points by it, others do not."""
    write_pcd(tmp_path / "moved.pcd", np.ones((2, 3)), "ascii")
    content = (tmp_path / "moved.pcd").read_text().replace("VIEWPOINT 0 0 0", "VIEWPOINT 10 0 0")
    (tmp_path / "moved.pcd").write_text(content)
    with pytest.raises(FileFormatError, match="VIEWPOINT 10"):
        read_points(tmp_path / "moved.pcd")
    assert read_points(tmp_path / "moved.pcd", ignore_viewpoint=True).tolist() == [[1, 1, 1]] * 2


def test_noise_of_the_scanner_is_tolerated() -> None:
    """Of a wall whose distances are off by 5 cm most is known once that is said, and little before."""
    generator = torch.Generator().manual_seed(0)
    rays = lidar()
    rays = rays[rays[:, 2] > 0.5]
    distance = 3.0 / rays[:, 2]
    noisy = rays * (distance + 0.05 * torch.randn(len(rays), generator=generator))[:, None]
    onto = FisheyeCamera.from_field_of_view((48, 48), 1.0)
    none, valid, smaller = (
        truth_from_points(scale * noisy, onto, noise=scale * noise).valid
        for scale, noise in ((1, 0.0), (1, 0.05), (0.125, 0.05))
    )
    assert valid.float().mean() > 0.6
    assert valid.sum() > 1.5 * none.sum()
    assert torch.equal(smaller, valid)  # a smaller world, seen by a better scanner


@pytest.mark.parametrize(("hole", "known"), [(0.04, True), (0.06, False)])
def test_a_pixel_is_known_by_points_within_half_a_gap_of_its_ray(hole: float, known: bool) -> None:
    x, y = torch.meshgrid(*(torch.linspace(-0.5, 0.5, 201),) * 2, indexing="xy")
    wall = torch.stack((x, y, torch.ones_like(x)), -1)[torch.hypot(x, y) > hole]
    truth = truth_from_points(wall, FisheyeCamera.from_field_of_view((3, 3), 0.6), gap=0.1)
    assert bool(truth.valid[1, 1]) == known


@pytest.mark.parametrize(
    ("angle", "distance", "known"),
    [(0.04, 2.0, False), (0.06, 2.0, True), (0.06, 0.8, False), (0.12, 0.8, True)],
)
def test_a_point_behind_a_plane_is_asked_about_half_as_far_away_as_one_in_front(
    angle: float, distance: float, known: bool
) -> None:
    """Through a hole in a wall at 1 m, of a gap of 0.1."""
    x, y = torch.meshgrid(*(torch.linspace(-0.5, 0.5, 201),) * 2, indexing="xy")
    wall = torch.stack((x, y, torch.ones_like(x)), -1)[torch.hypot(x - angle, y) > 0.038]
    points = torch.cat((wall, distance * torch.tensor([[angle, 0.0, 1.0]])))
    truth = truth_from_points(points, FisheyeCamera.from_field_of_view((3, 3), 0.6), gap=0.1)
    assert bool(truth.valid[1, 1]) == known


def test_planes_so_steep_that_depth_hangs_on_the_pixel_are_not_told() -> None:
    """A floor out to its horizon: no depth is more than a quarter off that of the point that it comes from."""
    x, z = torch.meshgrid(torch.linspace(-4, 4, 320), torch.linspace(0.5, 12, 600), indexing="ij")
    points = torch.stack((x, 0 * x + 1.0, z), -1).reshape(-1, 3)
    camera = FisheyeCamera.from_field_of_view((11, 11), 1.2)
    depth, valid = truth_from_points(points, camera, gap=0.1)
    distance = points.double().norm(dim=-1)
    pixels = _pixels_of(camera, points.double() / distance[:, None]) + 1
    nearest = (
        torch.full((122,), math.inf).scatter_reduce(0, pixels, distance.float(), "amin")[1:].view(11, 11)
    )
    assert valid.sum() > 30
    assert (depth / nearest)[valid].max() < 1.3


class BehindTheRig(ScannedFrames):
    """One frame, whose points, 3 cm off as of a LiDAR, the second camera alone sees."""

    def __init__(self, root: Path) -> None:
        super().__init__(root, height=16)
        self.fixed_rig = ring_rig(2, image_size=(16, 16))
        self.names = ["a"]
        self.images = {"a": {name: root / f"{name}.png" for name in self.fixed_rig.names}}
        for path in self.images["a"].values():
            write_image(path, torch.zeros(3, 16, 16))

    def points(self, name: str) -> torch.Tensor:
        axis = self.fixed_rig.axes[1]
        rays = Icosphere(5).vertices
        rays = rays[rays @ axis > 0.5]
        return (3 + 0.03 * torch.randn(len(rays), 1, generator=torch.Generator().manual_seed(0))) * rays


@pytest.mark.filterwarnings("error")
def test_points_that_any_camera_sees_are_in_the_frame_of_the_rig(tmp_path: Path) -> None:
    sample = BehindTheRig(tmp_path)[0]
    assert 0.12 < sample["valid"].float().mean() < 0.5  # half as many if no noise was expected
