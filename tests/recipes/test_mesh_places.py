# SPDX-License-Identifier: Apache-2.0
"""Places in meshes as scenes of data sets and recipes: exact depth, and the same in the file."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

pytest.importorskip("embreex")
trimesh = pytest.importorskip("trimesh")

from sphericalvision.cameras import EquirectangularCamera, ring_rig  # noqa: E402
from sphericalvision.core import ArgumentError, MissingFileError  # noqa: E402
from sphericalvision.data import SampleView  # noqa: E402
from sphericalvision.icosphere import Icosphere  # noqa: E402
from sphericalvision.io.images import read_image  # noqa: E402
from sphericalvision.recipes.datamodules.scenes import SceneDataModule  # noqa: E402
from sphericalvision.scenes import (  # noqa: E402
    MeshScene,
    World,
    ray_depth,
    render_camera,
)
from sphericalvision.scenes.meshes import (  # noqa: E402
    PlacedMesh,
    free_place,
    mesh_files,
)
from tests.recipes.tiny import Run  # noqa: E402

HALF = torch.tensor([3.0, 1.5, 4.0])
ROOM_MESH = trimesh.creation.box((2 * HALF).numpy())
ROOM = MeshScene(ROOM_MESH)


def directions(count: int) -> torch.Tensor:
    return torch.nn.functional.normalize(
        torch.randn(count, 3, generator=torch.Generator().manual_seed(0)), dim=-1
    )


def test_depth_from_a_place_in_a_box_is_that_of_the_closed_form() -> None:
    """Turned and moved, and seen from a rig whose centre is elsewhere."""
    place, yaw, center = torch.tensor([0.7, -0.3, 1.1]), 0.4, torch.tensor([5.0, 1.0, -2.0])
    rays = directions(1000)
    sin, cos = math.sin(yaw), math.cos(yaw)
    x, y, z = rays.unbind(-1)
    turned = torch.stack([cos * x + sin * z, y, cos * z - sin * x], -1)  # forward is turned to the right
    expected = ((HALF - turned.sign() * place) / turned.abs()).amin(-1)
    found = ray_depth(PlacedMesh(ROOM, place, yaw, center), center, rays)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)


def test_places_are_free_and_repeatable() -> None:
    for seed in range(10):
        scene = free_place(ROOM, seed, clear_radius=0.6)
        assert ray_depth(scene, torch.zeros(3), directions(500)).min() > 0.59
        assert torch.equal(scene.place, free_place(ROOM, seed).place)
    assert not torch.equal(free_place(ROOM, 0).place, free_place(ROOM, 1).place)
    with pytest.raises(ArgumentError, match=r"no place for a rig with 2\.00 m"):
        free_place(ROOM, 0, clear_radius=2.0)


def test_places_are_above_ground_where_there_is_any() -> None:
    """An open square has as much room beneath it as above; two walls in the air have no ground."""
    ground = trimesh.creation.box((40.0, 0.1, 40.0))
    tower = trimesh.creation.box((1.0, 30.0, 1.0))  # reaches as far down as up
    for seed in range(10):
        assert free_place(MeshScene(ground + tower), seed).place[1] < -0.6
    walls = [trimesh.creation.box((0.1, 6.0, 12.0)).apply_translation((x, 0, 0)) for x in (-1.5, 1.5)]
    assert free_place(MeshScene(walls[0] + walls[1]), 0).place[0].abs() < 0.9


@pytest.fixture(scope="module")
def glb(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("meshes") / "objects.glb"
    ROOM_MESH.export(path)
    return path


def test_a_file_as_data_is_seen_from_places_in_it(glb: Path, tmp_path: Path) -> None:
    """Samples of the recipe's data module, beside the box seen from the place that each seed draws."""
    rig = ring_rig(2, radius=0.1, image_size=(32, 32))
    module = SceneDataModule(rig=rig, mesh=str(glb), cache_dir=str(tmp_path), num_test=2, num_train=1)
    module.view = SampleView(level=4, depth_level=2)
    module.render("test")
    cached = sorted(path.name for path in tmp_path.rglob("*.npz"))
    assert len(cached) == 2
    assert all(name.startswith("objects-") for name in cached)
    for number in range(2):
        sample = module.dataset("test")[number]
        place = free_place(ROOM, 2_000_000 + number, 0.6)
        turned = Icosphere(2).vertices @ place.mesh_from_world.T
        truth = ((HALF - turned.sign() * place.place) / turned.abs()).amin(-1)
        torch.testing.assert_close(sample["inverse_depth"].reciprocal(), truth, rtol=1e-3, atol=1e-3)


def test_files_are_found_and_told(glb: Path, tmp_path: Path) -> None:
    folder = glb.parent
    assert mesh_files(str(folder)).paths == (glb,)
    assert mesh_files([str(glb), str(glb)]).path(1) == glb
    changed = tmp_path / glb.name
    trimesh.creation.box((4, 3, 4)).export(changed)
    assert mesh_files(str(changed)).name(3) != mesh_files(str(glb)).name(3)
    assert mesh_files(str(glb), scale=2.0).name(3) != mesh_files(str(glb)).name(3)
    with pytest.raises(MissingFileError):
        mesh_files(str(tmp_path / "nothing.glb"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(ArgumentError, match=r"empty, found none"):
        mesh_files(str(tmp_path / "empty"))
    with pytest.raises(ArgumentError, match="not into meshes"):
        World(ring_rig(2), meshes=mesh_files(str(glb)), carrier="pole")


def test_panoramas_of_a_mesh_are_seamless() -> None:
    picture = render_camera(free_place(ROOM, 3), EquirectangularCamera((16, 32)), torch.eye(4))
    assert picture.min() > 0


def test_the_render_command_takes_meshes_and_carriers(run: Run, tmp_path: Path) -> None:
    trimesh.creation.box((4.0, 3.0, 5.0)).export(tmp_path / "box.glb")
    small = ("rig=ring", "rig.image_size=[24,24]", "num_frames=1", "height=16", "samples_per_pixel=1")
    run("render", "mesh=box.glb", *small, "output=mesh")
    assert (tmp_path / "mesh/cam1/00001.png").is_file()
    run("render", "kind=floating", "rig=ugv", "carrier=vehicle", *small[1:], "output=ugv")
    run("render", "kind=floating", "rig=ugv", *small[1:], "output=bare")
    images = [read_image(tmp_path / folder / "cam1/00001.png") for folder in ("ugv", "bare")]
    assert (images[0] - images[1]).abs().max() > 0.1
