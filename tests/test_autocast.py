# SPDX-License-Identifier: Apache-2.0
"""Autocast moves no ray, pose or picture: every public verb of cameras, rigs, trajectories, geometry and pictures.

``tests/test_operator_laws.py`` has the same law for functions of tensors; here is what it leaves out, and every method.
A new name or method is in one of the two tables.
"""

import inspect
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from sphericalvision import cameras, geometry, viz
from sphericalvision.cameras import Camera, CameraRig, KannalaBrandtCamera, Trajectory, ring_rig
from sphericalvision.icosphere import Icosphere
from tests.laws.operators import CALLS

SIZE = (24, 32)


def lens() -> KannalaBrandtCamera:
    return KannalaBrandtCamera([11.3, 11.1], [15.7, 11.2], [0.013, -0.004, 0.001, 0.0], SIZE, 1.3)


def turned() -> CameraRig:
    """A rig whose numbers have all their digits, 12 m from the origin."""
    turn = geometry.transform_from_axis_angle(torch.tensor([0.31, -1.17, 0.23]), torch.zeros(3))[:3, :3]
    rig = ring_rig(3, radius=0.1237, image_size=SIZE).rotated(tilt=0.1, rotation=turn)
    poses = rig.world_from_camera.clone()
    poses[:, :3, 3] += torch.tensor([12.3456, -1.2345, 3.4567])
    return CameraRig([lens()] * 3, poses, {"cam1": torch.ones(SIZE, dtype=torch.bool)})


def way() -> Trajectory:
    poses = torch.cat((turned().world_from_camera, turned().scaled(1.1).world_from_camera)).double()
    return Trajectory([f"{number / 10:.1f}" for number in range(6)], poses)


def image(*lead: int) -> Tensor:
    return torch.rand(*lead, 3, *SIZE, generator=torch.Generator().manual_seed(1))


def images() -> dict[str, Tensor]:
    return {name: image() for name in turned().names}


def rays() -> Tensor:
    return Icosphere(2).vertices


def points() -> Tensor:
    return torch.tensor([12.3, -1.2, 3.4]) + 2.345 * rays()


def depth() -> Tensor:
    return 1.2345 + torch.rand(32, 64, generator=torch.Generator().manual_seed(2))


def file(write: Callable[[Path], Any], path: str) -> bytes:
    write(Path(path))
    return Path(path).read_bytes()


def written(save: Callable[[Any, str], None], read: Callable[[str], Any], value: Any) -> Any:
    save(value, "file.yaml")
    return read("file.yaml")


def kornia_camera() -> Any:
    return cameras.to_kornia(cameras.PinholeCamera([11.3, 11.1], [15.7, 11.2], SIZE))


NAMES: dict[str, Callable[[], Any]] = {
    "read_camera": lambda: written(cameras.save_camera, cameras.read_camera, lens()),
    "read_cameras": lambda: written(cameras.save_rig, cameras.read_cameras, turned()),
    "read_rig": lambda: written(cameras.save_rig, cameras.read_rig, turned()),
    "save_camera": lambda: file(lambda path: cameras.save_camera(lens(), path), "camera.yaml"),
    "save_rig": lambda: file(lambda path: cameras.save_rig(turned(), path), "rig.yaml"),
    "read_trajectory": lambda: (
        Path("way.txt").write_text("0.0 1.23456 0 2 0 0 0 1\n0.1 1.3 0 0.5 0.6 0 0 0.8\n"),
        cameras.read_trajectory("way.txt").rig(lens(), [0, 1]),
    ),
    "field_of_view": lambda: cameras.field_of_view(lens()),
    "overlap": lambda: cameras.overlap(torch.arange(162) % 4, Icosphere(2).solid_angles),
    "convert": lambda: cameras.convert(lens(), "double_sphere"),
    "compare_cameras": lambda: cameras.compare_cameras(
        lens(), lens().with_intrinsics(focal_length=torch.tensor([9.87, 9.76]))
    ),
    "rectified_pairs": lambda: [
        (pair.baseline, *pair.rectify(images())) for pair in cameras.rectified_pairs(turned())
    ],
    "fit_inverse_polynomial": lambda: cameras.fit_inverse_polynomial(
        cameras.convert(lens(), "ocam").camera  # type: ignore[arg-type]
    ),
    "straighten": lambda: cameras.straighten(lens()),
    "straighten_rig": lambda: cameras.straighten_rig(turned()),
    "from_kornia": lambda: cameras.from_kornia(kornia_camera()),
    "to_kornia": lambda: kornia_camera().params,
    "ring_rig": lambda: ring_rig(5, image_size=SIZE),
    "Trajectory": lambda: way().world_from_camera,
    "angle_map": lambda: viz.angle_map(lens()),
    "coverage_panorama": lambda: viz.coverage_panorama(turned(), 32),
    "depth_panorama": lambda: viz.depth_panorama(depth(), 0.5),
    "depth_to_color": lambda: viz.depth_to_color(depth(), 0.5),
    "error_panorama": lambda: viz.error_panorama(depth(), 3.0),
    "error_to_color": lambda: viz.error_to_color(depth(), 3.0),
    "icosphere_mesh": lambda: viz.icosphere_mesh(1.23 + rays()[:, 0].abs()).vertices,
    "sphere_mesh": lambda: np.asarray(viz.sphere_mesh(rays()[:, 1]).visual.vertex_colors),
    "rgb_panorama": lambda: viz.rgb_panorama(turned(), images(), 32, depth()),
    "rig_picture": lambda: viz.rig_picture(turned()),
    "sheet": lambda: viz.sheet([np.zeros((8, 8, 3), np.uint8)]),
    "save_point_cloud": lambda: file(
        lambda path: viz.save_point_cloud(path, points(), rays().abs(), rays()), "cloud.ply"
    ),
}  # fmt: skip

METHODS: dict[type, dict[str, Callable[[], Any]]] = {
    Camera: {
        "project": lambda: lens().project(rays()),
        "unproject": lambda: lens().unproject(lens().pixel_grid()),
        "contains": lambda: lens().contains(lens().pixel_grid()),
        "sample": lambda: lens().sample(image(), rays()),
        "interpolate": lambda: lens().interpolate(image(), lens().pixel_grid().reshape(-1, 2) + 0.3),
        "pixel_grid": lambda: lens().pixel_grid(),
        "to": lambda: lens().to(torch.float32),
        "with_intrinsics": lambda: lens().with_intrinsics(focal_length=torch.tensor([9.87, 9.76])),
        "with_max_angle": lambda: lens().with_max_angle(1.2345),
        "resized": lambda: lens().resized((12, 16)),
        "cropped": lambda: lens().cropped(1, 2, 12, 16),
        "equals": lambda: lens().equals(lens()),
        "select": lambda: Camera.stack([lens(), lens().resized(SIZE)]).select(1),
        "stack": lambda: type(lens()).stack([lens(), lens()]),
    },
    CameraRig: {
        "to": lambda: turned().to(torch.float64),
        "in_world": lambda: turned().replaced(origin=torch.tensor([4e5, 0, 5e6]).double()).in_world(),
        "replaced": lambda: turned().replaced(masks={}),
        "subset": lambda: turned().subset([0, 2]),
        "permuted": lambda: turned().permuted([1, 2, 0]),
        "rotated": lambda: turned().rotated(0.1, geometry.transform_from_axis_angle(*2 * [rays()[7]])[:3, :3]),
        "resized": lambda: turned().resized((12, 16)),
        "scaled": lambda: turned().scaled(1.234),
        "select": lambda: CameraRig.stack([turned(), turned().scaled(1.1)]).select(1),
        "stack": lambda: CameraRig.stack([turned(), turned().scaled(1.1)]),
        "project": lambda: turned().project(points()),
        "project_along": lambda: turned().project_along(rays(), torch.tensor([0.0, 0.123, 1.234])),
        "points_seen": lambda: turned().points_seen(rays(), torch.tensor([0.0, 0.123])),
        "to_yaml": lambda: file(turned().to_yaml, "rig.yaml"),
        "camera_from_world": lambda: turned().camera_from_world,
        "center": lambda: turned().center,
        "radius": lambda: turned().radius,
        "baselines": lambda: turned().baselines,
        "axes": lambda: turned().axes,
        "max_angles": lambda: turned().max_angles,
        "positions": lambda: turned().positions,
    },
    Trajectory: {
        "positions": lambda: way().positions,
        "windows": lambda: way().windows(3, spacing=0.13),
        "rig": lambda: (way().rig(lens(), [0, 2, 5]), way().rig(turned(), [1, 3])),
        "turned": lambda: [way().turned(up).world_from_camera for up in ("y", "z", "camera")],
        "matches": lambda: torch.tensor([*way().matches(["0.1", "0.3"]).values()]),
        "of_images": lambda: way().of_images(["0.1", "0.3"]).world_from_camera,
    },
}  # fmt: skip
WITHOUT_NUMBERS = {
    Camera: {"batch_shape", "device", "dtype", "edges"},
    CameraRig: {"names", "batch_shape"},
    Trajectory: set[str](),
}
CLASSES = {"Camera", "RectifiedPair", "Projection", "Unprojection", "register_camera", "calibration"}


def values(result: Any) -> Iterable[Any]:
    """Everything in a result that can be compared: tensors, arrays, numbers, bytes, in cameras and rigs too."""
    if isinstance(result, Camera | CameraRig | Trajectory):
        result = {key: value for key, value in vars(result).items() if not key.startswith("_")}
    if isinstance(result, Mapping):
        result = list(result.values())
    if isinstance(result, tuple | list):
        for part in result:
            yield from values(part)
    elif isinstance(result, Tensor):
        yield result.float().numpy() if result.dtype == torch.bfloat16 else result.numpy()
    else:
        yield result


def law(verb: Callable[[], Any], monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    monkeypatch.chdir(folder)
    alone = list(values(verb()))
    with torch.autocast("cpu", torch.bfloat16):
        inside = list(values(verb()))
    assert len(alone) == len(inside) > 0
    for expected, found in zip(alone, inside, strict=True):
        if isinstance(expected, np.ndarray | float):
            assert np.asarray(found).dtype == np.asarray(expected).dtype
            np.testing.assert_array_equal(found, expected)
        else:
            assert found == expected


def test_every_public_verb_is_in_a_table() -> None:
    names = {name for room in (cameras, geometry, viz) for name in dir(room) if not name.startswith("_")}
    models = {kind.__name__ for kind in vars(cameras).values() if inspect.isclass(kind)}
    assert names - set(CALLS) - (models - {"Trajectory"}) - CLASSES == set(NAMES)
    for kind, verbs in METHODS.items():
        public = {
            name
            for name, value in inspect.getmembers(kind)
            if not name.startswith("_") and (callable(value) or isinstance(value, property))
        }
        assert public - WITHOUT_NUMBERS[kind] == set(verbs), kind


@pytest.mark.parametrize("name", NAMES)
def test_names(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    law(NAMES[name], monkeypatch, tmp_path)


@pytest.mark.parametrize(
    ("kind", "name"), [(kind, name) for kind, verbs in METHODS.items() for name in verbs]
)
def test_methods(kind: type, name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    law(METHODS[kind][name], monkeypatch, tmp_path)


def test_the_law_notices_products_in_bfloat16(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(AssertionError):
        law(lambda: (rays() @ rays()[:3].T) * math.pi, monkeypatch, tmp_path)
