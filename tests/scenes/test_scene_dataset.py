# SPDX-License-Identifier: Apache-2.0
"""Rendered samples on the icosphere: entries, cache, tilts, and the exact five-fold rotation."""

import io
import math
import pickle
import random
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.data import SampleView
from sphericalvision.data.augmentation.fivefold import RotateFivefold, rotate_fivefold
from sphericalvision.data.augmentation.sphere_rotation import yaw_angle, yaw_rotation
from sphericalvision.icosphere import Icosphere
from sphericalvision.scenes import make_scene, ray_depth, render_directions, render_rig
from tests.worlds import same, scenes


def test_sample_holds_what_the_contract_says(rig: CameraRig) -> None:
    data = scenes(rig, 3, 5, SampleView(4, 2), kind=["room", "floating"])
    assert len(data) == 3
    sample = data[0]
    assert sample["images"].shape == (4, 3, Icosphere(4).num_vertices)
    assert sample["images"].dtype == torch.float32
    assert sample["images"].abs().max() <= 1
    assert sample["inverse_depth"].shape == sample["valid"].shape == (Icosphere(2).num_vertices,)
    assert sample["inverse_depth"].dtype == torch.float32
    assert sample["valid"].dtype == torch.bool
    assert sample["valid"].all()
    assert sample["rig"] is rig
    assert [data[k]["frame"] for k in range(3)] == ["floating-00000005", "room-00000006", "floating-00000007"]


def test_ground_truth_is_exact_ray_depth_from_the_centre_of_the_rig() -> None:
    rig = ring_rig(image_size=(8, 8))
    poses = rig.world_from_camera.clone()
    poses[:, :3, 3] += torch.tensor([1.0, 2.0, 3.0])
    away = CameraRig(rig.cameras, poses)
    sample = scenes(away, 1, 3, SampleView(4, 2), min_depth=1.1)[0]
    depth = 2 * ray_depth(make_scene("room", 3), torch.zeros(3), Icosphere(2).vertices)
    torch.testing.assert_close(sample["inverse_depth"], 1 / depth, rtol=1e-3, atol=1e-4)


def test_images_show_what_the_cameras_see_in_world_directions() -> None:
    """At a vertex that a camera sees, the sphere holds the colour along that direction from the camera."""
    rig = ring_rig(image_size=(160, 160))
    sample = scenes(rig, 1, 1, SampleView(4, 2))[0]
    scene = make_scene("room", 1, center=rig.center)
    vertices = Icosphere(4).vertices
    spread = math.radians(220) / 160
    for image, pose, axis in zip(sample["images"], rig.world_from_camera, rig.axes, strict=True):
        direct = render_directions(scene, pose[:3, 3], vertices, spread) * 2 - 1
        seen = vertices @ axis > math.cos(math.radians(108))
        hidden = vertices @ axis < math.cos(math.radians(111))
        assert (image[:, seen] - direct[:, seen]).abs().median() < 0.05
        assert (image[:, hidden] == 0).all()


def test_another_parameter_never_reads_a_stale_sample(tmp_path: Path) -> None:
    rig = ring_rig(image_size=(16, 16))
    mask = torch.ones(16, 16, dtype=torch.bool)
    mask[8:] = False
    masked = CameraRig(rig.cameras, rig.world_from_camera, {rig.names[0]: mask})
    variants: list[dict[str, Any]] = [
        {},
        {"view": SampleView(4, 2)},
        {"view": SampleView(3, 2)},
        {"kind": ["room", "floating"]},
        {"tilts": (0.0, 0.1)},
        {"carrier": "pole"},
        {"samples_per_pixel": 2},
        {"min_depth": 0.5},
        {"view": SampleView(3, 1, antialias=True)},
        {"rig": ring_rig(radius=0.21, image_size=(16, 16))},
        {"rig": ring_rig(num_cameras=3, image_size=(16, 16))},
        {"rig": ring_rig(image_size=(16, 18))},
        {"rig": masked},
    ]
    folders = set()
    for variant in variants:
        arguments = {"rig": rig, "cache_dir": tmp_path} | variant
        folders.add(scenes(**arguments).cache.folder)
    assert len(folders) == len(variants)
    again = scenes(ring_rig(image_size=(16, 16)), 5, 9, cache_dir=tmp_path)
    assert again.cache.folder in folders


def test_whatever_happens_to_a_file_it_is_made_anew(rig: CameraRig, tmp_path: Path) -> None:
    """Cut, flipped, replaced: the sample is the same, and the file is whole again; nothing temporary stays."""
    data = scenes(rig, cache_dir=tmp_path)
    first = data[0]
    paths = sorted(tmp_path.rglob("*.npz"))
    rng = random.Random(0)
    for path in paths:
        whole = path.read_bytes()
        damaged = [b"", b"not a zip file", bytes(len(whole)), whole + whole, whole[5:]]
        damaged += [whole[: rng.randrange(len(whole))] for _ in range(8)]
        for _ in range(20):
            flipped = bytearray(whole)
            for _ in range(rng.choice((1, 1, 3, 30))):
                # headers and the directory at the end are where surprises are
                place = rng.choice((rng.randrange(150), -1 - rng.randrange(150), rng.randrange(len(whole))))
                flipped[place] ^= 1 << rng.randrange(8)
            damaged.append(bytes(flipped))
        other = io.BytesIO()
        np.savez(other, images=np.zeros((4, 3, 42), np.uint8), inverse_depth=np.zeros(12))
        wider = io.BytesIO()
        np.savez(wider, **{name: array + 0.25 for name, array in np.load(io.BytesIO(whole)).items()})
        objects = io.BytesIO()
        np.savez(objects, images=np.array([{}]))
        for content in (*damaged, other.getvalue(), wider.getvalue(), objects.getvalue()):
            path.write_bytes(content)
            assert same(first, data[0])
    assert [p for p in sorted(tmp_path.rglob("*")) if p.is_file()] == paths
    assert same(first, scenes(rig, cache_dir=tmp_path)[0])


def test_several_workers_share_a_cache(rig: CameraRig, tmp_path: Path) -> None:
    data = scenes(rig, 2, cache_dir=tmp_path)
    with ThreadPoolExecutor(4) as pool:
        samples = list(pool.map(data.__getitem__, [0, 1, 0, 1, 0, 1]))
    assert all(same(samples[k], samples[k % 2]) for k in range(6))
    assert len(list(tmp_path.rglob("*.npz"))) == 2


def test_there_is_no_sample_after_the_last(rig: CameraRig) -> None:
    with pytest.raises(IndexError, match="3 is outside"):
        scenes(rig, 3)[3]


@pytest.mark.parametrize("level", [0, 1, 3])
@pytest.mark.parametrize("steps", [1, 2, -1, 5])
def test_rotated_vertices_are_the_vertices(level: int, steps: int) -> None:
    """Turning the world by R moves vertex w's value to the vertex at R w: rotated positions, read there, match."""
    vertices = Icosphere(level, dtype=torch.float64).vertices
    turned = vertices @ yaw_rotation(yaw_angle(torch.tensor(steps), 5)).T
    torch.testing.assert_close(rotate_fivefold(turned.T, steps).T, vertices, rtol=0, atol=1e-12)


def test_random_rotation_follows_its_generator(rig: CameraRig) -> None:
    sample = scenes(rig)[0]
    first, again = (RotateFivefold(torch.Generator().manual_seed(4))(sample) for _ in range(2))
    assert same(first, again)


def test_data_sets_go_to_processes_that_are_started_anew() -> None:
    """Where processes are not forked (macOS, Windows), a loader's workers get their data set as bytes."""
    samples = scenes(ring_rig(image_size=(8, 8)), view=SampleView(3, 1, panorama=(8, 16)))
    sample, again = samples[0], pickle.loads(pickle.dumps(samples))[0]
    assert same(sample, again)
    assert torch.equal(sample["panorama_inverse_depth"], again["panorama_inverse_depth"])


TILTS = (math.radians(-15), math.radians(45))


def test_each_scene_has_a_tilt_of_its_own_and_the_same_depth(rig: CameraRig) -> None:
    tilted, level = (scenes(rig, 3, 5, tilts=tilts) for tilts in (TILTS, None))
    looks = [[math.degrees(math.asin(axis[1])) for axis in tilted[k]["rig"].axes] for k in range(3)]
    assert all(-23 <= angle <= 53 for angles in looks for angle in angles)
    assert all(max(angles) - min(angles) <= 16 for angles in looks)
    assert abs(looks[0][0] - looks[1][0]) > 1
    assert abs(looks[1][0] - looks[2][0]) > 1
    for k in range(3):
        assert torch.equal(tilted[k]["inverse_depth"], level[k]["inverse_depth"])
        assert torch.equal(tilted[k]["rig"].positions, rig.positions)
        assert not torch.equal(tilted[k]["seen"], level[k]["seen"])


def test_tilts_are_all_between_the_least_and_the_largest(rig: CameraRig) -> None:
    world = scenes(rig, tilts=TILTS).world
    looks = torch.stack([world.frame(seed).true_rig.axes[:, 1].asin().mean() for seed in range(300)])
    middle, width = sum(TILTS) / 2, TILTS[1] - TILTS[0]
    assert looks.mean().item() == pytest.approx(middle, abs=width / 15)
    assert looks.std().item() == pytest.approx(width / math.sqrt(12), rel=0.15)


def test_images_are_taken_by_the_tilted_cameras(tmp_path: Path, rig: CameraRig) -> None:
    """From the cache, too, where each scene has another rig; cameras' images and those on the sphere alike."""
    view = SampleView(3, 1, images=True)
    tilted = scenes(rig, 2, view=view, tilts=TILTS, cache_dir=tmp_path)
    for _ in range(2):
        sample = tilted[1]
        pictures = render_rig(make_scene("room", 1, center=rig.center), sample["rig"])
        expected = torch.stack(list(pictures.values())) * 2 - 1
        seen = sample["fisheye_seen"][:, None]
        assert ((sample["fisheye"] - expected) * seen).abs().max() <= 0.51 / 127.5
    assert len(list(tmp_path.iterdir())) == 1
    other = scenes(rig, 2, view=view, cache_dir=tmp_path)
    assert not torch.equal(other[1]["fisheye"], sample["fisheye"])
