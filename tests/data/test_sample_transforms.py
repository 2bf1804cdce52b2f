# SPDX-License-Identifier: Apache-2.0
"""Samples onto the icosphere, and augmentations that change what they say and nothing else."""

import math
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sphericalvision.cameras import CameraRig, EquirectangularCamera, read_rig, ring_rig, sample_sphere
from sphericalvision.data.augmentation.photometric import PhotometricAugmentation
from sphericalvision.data.augmentation.transforms import RandomShift, ToSphere
from sphericalvision.data.collate import Sample
from sphericalvision.icosphere import Icosphere
from sphericalvision.sphere import Equirectangular
from tests.values import weighted_sum
from tests.worlds import frames_of_noise


def with_truth(rig: CameraRig, **size: int) -> Sample:
    """One whole sample, of a panorama's size."""
    sample = frames_of_noise(rig, [1], **size)[0]
    known = torch.ones_like(sample["inverse_depth"], dtype=torch.bool)
    return {**sample, "valid": known, "rig": rig}


def test_images_agree_with_the_rigs_own_lookup(rig: CameraRig) -> None:
    sample = with_truth(rig)
    to_sphere = ToSphere(4)
    values, seen = sample_sphere(rig, sample["images"], Icosphere(4).vertices, fill=0.5)
    for _ in range(2):  # computed, then from the table
        result = to_sphere(sample)
        torch.testing.assert_close(result["images"], values * 2 - 1, rtol=0, atol=1e-5)
        assert (result["images"].movedim(1, -1)[~seen] == 0).all()
    assert result["images"].shape == (4, 3, 2562)
    assert result["inverse_depth"].shape == result["valid"].shape == (162,)
    assert result["frame"] == sample["frame"]
    assert result["rig"] is rig


@pytest.mark.parametrize("antialias", [False, True])
def test_panoramas_are_looked_up_across_their_seam(antialias: bool) -> None:
    """Brightness (1 + backward) / 2 on panoramas of any size: exact where the left and right edges meet, too."""
    camera = EquirectangularCamera((96, 192))
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[1, :3, 3] = torch.tensor([0.2, 0.0, 0.0])
    rig = CameraRig([camera, camera], poses)
    rays = camera.unproject(camera.pixel_grid()).directions
    images = dict.fromkeys(rig.names, ((1 - rays[..., 2]) / 2).expand(3, -1, -1))
    to_sphere = ToSphere(3, antialias=antialias)
    expected = -Icosphere(3).vertices[:, 2]
    for _ in range(2):
        result = to_sphere.images(images, rig)
        torch.testing.assert_close(
            result, expected.expand(2, 3, -1), rtol=0, atol=0.02 if antialias else 2e-3
        )


def test_convention_images_are_world_aligned(rig: CameraRig) -> None:
    """Each camera sees brightness (1 + height) / 2: on the icosphere all agree, wherever they look."""
    images = {}
    for (name, camera), world_from_camera in zip(rig.cameras.items(), rig.world_from_camera, strict=True):
        rows, columns = torch.meshgrid(*map(torch.arange, camera.image_size), indexing="ij")
        rays = camera.unproject(torch.stack((columns, rows), dim=-1).float()).directions
        up = -(rays @ world_from_camera[:3, :3].T)[..., 1]
        images[name] = ((1 + up) / 2).nan_to_num(0.5)[None].expand(3, -1, -1)
    result = ToSphere(3).images(images, rig)
    up = -Icosphere(3).vertices[:, 1]
    seen = math.cos(math.radians(100)) < (Icosphere(3).vertices @ rig.world_from_camera[:, :3, 2].T).T
    assert ((result[:, 0] - up)[seen]).abs().max() < 0.02


def test_another_rig_gets_another_table() -> None:
    narrow, wide = (ring_rig(number, image_size=(50, 48)) for number in (4, 3))
    to_sphere = ToSphere(3)
    assert to_sphere(with_truth(narrow))["images"].shape[0] == 4
    assert to_sphere(with_truth(wide))["images"].shape[0] == 3
    fresh = ToSphere(3)(with_truth(narrow))["images"]
    assert torch.equal(to_sphere(with_truth(narrow))["images"], fresh)
    assert torch.equal(pickle.loads(pickle.dumps(to_sphere))(with_truth(narrow))["images"], fresh)


def test_ground_truth_is_the_nearest_pixel_not_a_mixture(rig: CameraRig) -> None:
    sample = with_truth(rig, height=32, width=64)
    result = ToSphere(4)(sample)
    pixels = Equirectangular(32, 64).directions.reshape(-1, 3)
    for vertex, value in zip(Icosphere(2).vertices, result["inverse_depth"], strict=True):
        place = (sample["inverse_depth"].flatten() == value).nonzero().flatten()
        angle = torch.rad2deg((pixels[place] @ vertex).clamp(-1, 1).acos()).min()
        assert angle <= math.hypot(2.8125, 2.8125) + 1e-3


def test_urban_truth_is_valid_near_the_horizon_only(rig: CameraRig) -> None:
    result = ToSphere(5, depth_level=4)(with_truth(rig, height=16, width=64))
    latitude = torch.asin(-Icosphere(4).vertices[:, 1]).rad2deg()
    assert torch.equal(result["valid"], latitude.abs() <= 45)
    assert (result["inverse_depth"][~result["valid"]] == 0).all()


def test_unknown_truth_stays_unknown(rig: CameraRig) -> None:
    sample = with_truth(rig)
    sample["valid"][:8] = False  # the upper half
    result = ToSphere(4)(sample)
    y = Icosphere(2).vertices[:, 1]
    assert not result["valid"][y < -0.2].any()
    assert result["valid"][y > 0.2].all()


def test_shift_moves_pixels_and_the_rig_stays(rig: CameraRig) -> None:
    u = torch.arange(48.0).expand(3, 50, 48) / 100
    sample = {**with_truth(rig), "images": dict.fromkeys(rig.names, u)}
    shifts = []
    for seed in range(100):
        result = RandomShift(0.5, torch.Generator().manual_seed(seed))(sample)
        moved = (u - result["images"]["cam1"])[:, 5:-5, 5:-5] * 100
        torch.testing.assert_close(moved, moved[0, 0, 0].expand_as(moved), rtol=0, atol=1e-3)
        shifts.append(moved[0, 0, 0])
    assert result["rig"] is rig
    spread = torch.stack(shifts)
    assert spread.mean().abs() < 0.2
    assert 0.4 < spread.std() < 0.6
    shifted = RandomShift(generator=torch.Generator().manual_seed(1))(with_truth(rig))["images"]
    assert weighted_sum(*shifted.values()) == pytest.approx(-10.1982, abs=1e-3)
    same = RandomShift(0.0)(with_truth(rig))["images"]["cam2"]
    torch.testing.assert_close(same, with_truth(rig)["images"]["cam2"], rtol=0, atol=1e-5)


def test_the_same_seed_augments_alike(rig: CameraRig) -> None:
    sample = with_truth(rig)
    state = torch.get_rng_state()

    def first(seed: int) -> torch.Tensor:
        augment = PhotometricAugmentation(generator=torch.Generator().manual_seed(seed))
        return augment(sample)["images"]["cam1"]

    assert torch.equal(first(1), first(1))
    assert not torch.equal(first(1), first(2))
    assert torch.equal(torch.get_rng_state(), state)  # kornia's draws do not leak


def test_brightness_changes_by_no_more_than_asked_for_each_camera_on_its_own() -> None:
    augment = PhotometricAugmentation(0.1, contrast=0.0, noise=0.0)
    images = torch.full((4, 3, 2, 2), 0.5)
    offsets = torch.stack([augment.apply_to(images, seed)[:, 0, 0, 0] - 0.5 for seed in range(50)])
    assert 0.08 < offsets.abs().max() <= 0.1 + 1e-6
    assert offsets.std(dim=1).min() > 1e-6


def test_contrast_and_noise_change_by_as_much_as_said() -> None:
    """By default contrast by a fifth, and noise of a hundredth for every other camera."""
    images = torch.full((4, 3, 40, 40), 0.4)
    stretched, noisy = (
        torch.stack([PhotometricAugmentation(0.0, **options).apply_to(images, seed) for seed in range(50)])
        / 0.4
        for options in ({"noise": 0.0}, {"contrast": 0.0})
    )
    gains, deviations = stretched.amax((2, 3, 4)), 0.4 * noisy.std((2, 3, 4))
    assert 0.8 <= gains.min() < 0.83
    assert 1.17 < gains.max() <= 1.2
    assert 0.4 < (deviations > 1e-6).float().mean() < 0.6
    assert deviations[deviations > 1e-6].mean().item() == pytest.approx(0.01, rel=0.03)


def test_cameras_of_different_sizes_are_augmented_pixel_by_pixel() -> None:
    small = torch.rand(3, 4, 5)
    large = torch.nn.functional.pad(small, (0, 3, 0, 2), value=0.3)
    first, second = (
        PhotometricAugmentation(noise=0.0, generator=torch.Generator().manual_seed(0))({"images": images})[
            "images"
        ]
        for images in ({"a": small, "b": large}, {"a": large, "b": small})
    )
    torch.testing.assert_close(second["a"][:, :4, :5], first["a"])
    torch.testing.assert_close(first["b"][:, :4, :5], second["b"])


def test_same_images_on_the_sphere_as_the_published_implementation(golden: Path) -> None:
    """Its remapping rounds pixel positions to 1/32 px, which is worth a few grey levels where images are steep."""
    numbers = np.load(golden / "image_io.npz")
    rig = read_rig(golden / "rig" / "poses.txt", translation_unit="cm")
    images = {}
    for name in rig.names:
        image = cv2.resize(numbers[f"img_lowres_{name}"], (768, 800), interpolation=cv2.INTER_CUBIC)
        images[name] = torch.from_numpy(image).movedim(-1, 0) / 255
    result = (ToSphere(4).images(images, rig) + 1) / 2 * 255
    order = Icosphere(4).subdivision_order
    for name, values in zip(rig.names, result, strict=True):
        expected = torch.from_numpy(numbers[f"ico_{name}"]).float()[order].T
        difference = (values - expected).abs()
        outside = torch.from_numpy(numbers[f"mapx_{name}"])[order] < 0
        assert (values[:, outside] == 127.5).all()
        assert difference[:, ~outside].max() <= 3
        assert difference[:, ~outside].mean() < 0.5
