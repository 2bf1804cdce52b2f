# SPDX-License-Identifier: Apache-2.0
"""Samples with the cameras' own images: only what is asked for, one cache, and turns that fit together."""

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from sphericalvision.cameras import CameraRig, EquirectangularCamera, ring_rig
from sphericalvision.data import PhotometricAugmentation, RotateFivefold, SampleView, collate_samples
from sphericalvision.data.augmentation.sphere_rotation import yaw_rotation
from sphericalvision.recipes.datamodules.depth_data_module import view_with
from sphericalvision.scenes import WorldSamples, make_scene, ray_depth, render_rig, world
from sphericalvision.sphere import Equirectangular
from tests.worlds import same
from tests.worlds import scenes as world_scenes

KEYS = {
    "sphere": {"images", "seen", "inverse_depth", "valid"},
    "depth": {"inverse_depth", "valid"},
    "fisheye": {"fisheye", "fisheye_seen"},
    "panorama": {"panorama_inverse_depth", "panorama_valid"},
}


EVERYTHING = SampleView(3, 1, True, (10, 20))


def scenes(rig: CameraRig, **options: Any) -> WorldSamples:
    return world_scenes(rig, 2, **({"view": EVERYTHING} | options))


def test_images_on_the_sphere_are_the_same_beside_the_cameras_own() -> None:
    rig = ring_rig(image_size=(64, 64))
    for antialias in (False, True):
        ours, others = (
            world_scenes(rig, 2, 4, SampleView(3, 1, images, antialias=antialias), kind=["room", "floating"])
            for images in (True, False)
        )
        for index in range(2):
            sample, other = ours[index], others[index]
            assert all(torch.equal(sample[key], other[key]) for key in KEYS["sphere"])


def test_fisheye_images_are_renderings_and_zero_out_of_view() -> None:
    rig = ring_rig(image_size=(40, 48))
    sample = world_scenes(rig, 1, 3, SampleView(images=True))[0]
    pictures = torch.stack(list(render_rig(make_scene("room", 3, center=rig.center), rig).values()))
    down, across = torch.meshgrid(torch.arange(40) - 19.5, torch.arange(48) - 23.5, indexing="ij")
    radius = torch.hypot(down, across)  # the image circle fills the shorter side
    assert (sample["fisheye"] - (pictures * 2 - 1))[..., radius < 20].abs().max() <= 0.51 / 127.5
    assert (sample["fisheye"][..., radius > 20] == 0).all()
    assert sample["fisheye"].shape == (4, 3, 40, 48)


def test_panoramas_are_exact(rig: CameraRig) -> None:
    sample = world_scenes(rig, 1, 3, SampleView(panorama=(16, 32)))[0]
    scene = make_scene("room", 3, center=rig.center)
    depth = ray_depth(scene, rig.center, Equirectangular(16, 32).directions)
    torch.testing.assert_close(sample["panorama_inverse_depth"], 1 / depth)
    assert torch.equal(sample["panorama_valid"], sample["panorama_inverse_depth"] <= 1 / 0.55)
    band = world_scenes(rig, 1, 3, SampleView(panorama=(8, 32)))[0]
    torch.testing.assert_close(band["panorama_inverse_depth"], sample["panorama_inverse_depth"][4:12])


@pytest.mark.parametrize("entries", [("sphere",), ("depth",), ("fisheye",), ("panorama",), tuple(KEYS)])
def test_only_what_is_asked_for_is_computed(
    entries: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    called: set[str] = set()

    def watch(name: str) -> None:
        original = getattr(world, name)
        monkeypatch.setattr(world, name, lambda *a: called.add(name) or original(*a))

    watch("render_rig")
    watch("ray_depth")
    sample = scenes(ring_rig(image_size=(16, 16)), view=view_with(entries, EVERYTHING))[0]
    assert set(sample) == set().union(*(KEYS[entry] for entry in entries)) | {"rig", "frame"}
    assert ("render_rig" in called) == bool({"sphere", "fisheye"} & set(entries))
    assert ("ray_depth" in called) == bool({"sphere", "depth", "panorama"} & set(entries))


@pytest.mark.parametrize("view", [EVERYTHING, SampleView(3, 1)], ids=str)
def test_cached_and_fresh_samples_are_equal_and_the_cache_is_read(
    view: SampleView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = ring_rig(image_size=(16, 16))
    fresh, cached = scenes(rig, view=view), scenes(rig, cache_dir=tmp_path, view=view)
    assert not cached.is_cached(0)
    first = fresh[0]
    assert same(first, cached[0])
    assert cached.is_cached(0)
    assert not cached.is_cached(1)
    monkeypatch.setattr(world, "make_scene", lambda *_: pytest.fail("made again"))
    assert same(first, scenes(rig, cache_dir=tmp_path, view=view)[0])


def test_a_turned_sample_is_one_of_the_turned_world() -> None:
    """The panorama by whole columns, the icosphere from chart to chart, the cameras with the world: all one turn."""
    rig = ring_rig(image_size=(32, 32))
    sample = scenes(rig, first_seed=2)[0]
    turned = RotateFivefold(steps=2)(sample)
    turn = yaw_rotation(torch.tensor(4 * math.pi / 5))
    world = make_scene("room", 2, center=rig.center).transformed(turn)
    depth = ray_depth(world, turned["rig"].center, Equirectangular(10, 20).directions)
    assert ((turned["panorama_inverse_depth"] * depth - 1).abs() < 1e-3).float().mean() > 0.97
    pictures = torch.stack(list(render_rig(world, turned["rig"]).values())) * 2 - 1
    seen = turned["fisheye_seen"][:, None].expand_as(pictures)
    assert ((turned["fisheye"] - pictures)[seen].abs() < 0.02).float().mean() > 0.98
    assert torch.equal(turned["images"], RotateFivefold(steps=2)({**sample})["images"])
    back = RotateFivefold(steps=-2)(turned)
    assert same(back, sample)


def test_colours_change_alike_on_the_sphere_and_in_the_images(rig: CameraRig) -> None:
    grey = torch.linspace(-0.8, 0.8, 12).view(4, 3, 1)
    sample = {"images": grey.expand(4, 3, 642).clone(), "fisheye": grey[..., None].expand(4, 3, 9, 9).clone()}
    sample["fisheye_seen"] = (torch.arange(9) > 0).expand(4, 9, 9)
    sample["fisheye"][..., 0] = 0.0
    augment = PhotometricAugmentation(noise=0.0, generator=torch.Generator().manual_seed(1))
    changed = augment({**sample, "rig": rig})
    torch.testing.assert_close(changed["images"][..., 0], changed["fisheye"][..., 4, 4])
    assert not torch.allclose(changed["images"], sample["images"])
    assert (changed["fisheye"][..., 0] == 0).all()


def test_batches_and_panoramic_cameras() -> None:
    """360° cameras are seen everywhere, and the two kinds of cameras agree about the same scene."""
    lenses = ring_rig(image_size=(96, 96))
    panoramas = CameraRig([EquirectangularCamera((64, 128))] * 4, lenses.world_from_camera)
    through_lenses, around = (
        collate_samples([scenes(rig, samples_per_pixel=2)[k] for k in range(2)])
        for rig in (lenses, panoramas)
    )
    assert around["fisheye"].shape == (2, 4, 3, 64, 128)
    assert around["seen"].all()
    seen = through_lenses["seen"][:, :, None].expand_as(around["images"])
    gap = (through_lenses["images"] - around["images"])[seen].abs()
    assert gap.median() < 0.03
    assert torch.equal(through_lenses["panorama_inverse_depth"], around["panorama_inverse_depth"])


def test_cameras_of_several_sizes_see_the_sphere(rig: CameraRig) -> None:
    one, other = rig.cameras["cam1"], ring_rig(image_size=(20, 20)).cameras["cam1"]
    mixed = CameraRig([one, other], rig.world_from_camera[:2])
    assert "images" in scenes(mixed, view=SampleView(3))[0]
