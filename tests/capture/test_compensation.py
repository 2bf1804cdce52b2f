# SPDX-License-Identifier: Apache-2.0
"""Noise of cameras: how strong it is, and what smoothing it does for depth."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import Predictor, calibrate_photometry
from sphericalvision.capture.preparation.photometry import PhotometricCalibration
from sphericalvision.capture.preparation.preparation import (
    LEAST_NOISE,
    Compensation,
    Compensator,
    Preparation,
    _inside,
    _noise,
    compensated,
)
from sphericalvision.scenes import make_scene, render_rig
from sphericalvision.sphere.intake import signed


@pytest.fixture(scope="module")
def rig() -> CameraRig:
    return ring_rig(3, image_size=(128, 128))


@pytest.fixture(scope="module")
def clean(rig: CameraRig) -> dict[str, Tensor]:
    return render_rig(make_scene("room", seed=3), rig, 2)


def noise_of(image: Tensor, usable: Tensor | None = None) -> float:
    return _noise(image[None], None if usable is None else _inside(usable)).item()


def noisy(images: dict[str, Tensor], amount: float) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    return {
        name: (image + amount * torch.randn(image.shape, generator=generator)).clamp(0, 1)
        for name, image in images.items()
    }


@pytest.mark.parametrize("amount", [0.02, 0.03, 0.08])
def test_noise_is_found(clean: dict[str, Tensor], amount: float) -> None:
    for image in noisy(clean, amount).values():
        assert noise_of(image) == pytest.approx(amount, rel=0.2)  # texture adds


def test_clipped_values_and_what_is_outside_of_the_lens_say_nothing(clean: dict[str, Tensor]) -> None:
    image = noisy(clean, 0.03)["cam1"]
    image[:, :80] = 0.0
    assert noise_of(image) == pytest.approx(0.03, rel=0.15)
    assert noise_of(torch.ones(3, 16, 16)) == 0.0
    assert noise_of(torch.linspace(0.3, 0.7, 64).expand(3, 64, 64)) == pytest.approx(0.0, abs=1e-4)


def test_large_images_are_sampled(clean: dict[str, Tensor]) -> None:
    large = torch.nn.functional.interpolate(clean["cam1"][None], size=(900, 900), mode="bicubic")[0]
    assert noise_of(noisy({"a": large.clamp(0, 1)}, 0.02)["a"]) == pytest.approx(0.02, rel=0.1)


def denoised(image: Tensor, usable: Tensor | None = None, shrink: int = 1) -> Tensor:
    """Means over squares of an image ``([b,] c, h, w)`` without noise."""
    rig = ring_rig(2, image_size=tuple(image.shape[-2:]))
    rig = rig if usable is None else rig.replaced(masks={"cam1": usable})

    def averaged(images: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {name: means(each, shrink) for name, each in images.items()}

    frames = image.reshape(-1, *image.shape[-3:])
    smooth = Compensator(rig, averaged).smoothed({"cam1": frames})[0]["cam1"]
    return smooth.view(*image.shape[:-2], *smooth.shape[-2:])


def means(image: Tensor, shrink: int) -> Tensor:
    return torch.nn.functional.avg_pool2d(image, shrink, ceil_mode=True)


@pytest.mark.parametrize(("shrink", "least"), [(1, 0.36), (2, 0.7), (3, 0.7)])
def test_means_are_smoothed_and_masked_pixels_have_no_influence(
    clean: dict[str, Tensor], shrink: int, least: float
) -> None:
    usable = torch.ones(128, 128, dtype=torch.bool)
    usable[70:] = False
    for name, image in noisy(clean, 0.05).items():
        truth = means(clean[name], shrink)
        results = means(image, shrink), denoised(image, shrink=shrink)
        before, after = ((each - truth).square().mean() for each in results)
        assert after < least * before
        other = image.where(usable, torch.rand(image.shape, generator=torch.Generator().manual_seed(1)))
        part = [denoised(each, usable, shrink)[:, : 70 // shrink] for each in (image, other)]
        torch.testing.assert_close(*part, rtol=0, atol=1e-3)
        assert LEAST_NOISE < noise_of(other, usable) == noise_of(image, usable) != noise_of(other)
    assert denoised(clean["cam1"], shrink=shrink).equal(means(clean["cam1"], shrink))


def test_a_predictor_smooths_at_the_resolution_that_its_network_sees(
    rig: CameraRig, clean: dict[str, Tensor]
) -> None:
    """At a level four times as coarse as the images, squares of four pixels are one value."""
    predictor = Predictor(rig, method="semi_global", level=3, min_depth=0.5)
    intake = predictor.network.intake(rig)
    assert {look.shrink for look in intake.lookups} == {4}
    faulty = noisy(clean, 0.05)
    smooth = intake.looked_up({name: denoised(image, shrink=4) for name, image in faulty.items()})
    torch.testing.assert_close(predictor.inputs(faulty)[0], signed(smooth, intake.seen), rtol=0, atol=1e-5)


def test_images_without_noise_stay_as_they_are(rig: CameraRig, clean: dict[str, Tensor]) -> None:
    assert all(noise_of(image) < LEAST_NOISE for image in clean.values())
    found = compensated(rig, clean)
    assert all(found[name].equal(image) for name, image in clean.items())


def test_frames_of_a_batch_are_judged_one_by_one(clean: dict[str, Tensor]) -> None:
    image, other = clean["cam1"], noisy(clean, 0.03)["cam1"]
    batch = denoised(torch.stack([image, other]))
    torch.testing.assert_close(batch, torch.stack([image, denoised(other)]))


def test_grey_images_of_one_channel(clean: dict[str, Tensor]) -> None:
    grey = noisy(clean, 0.03)["cam1"].mean(0, keepdim=True)
    assert denoised(grey).shape == grey.shape
    assert noise_of(denoised(grey)) < 0.5 * noise_of(grey)


def test_predictor_smooths_what_it_says(rig: CameraRig, clean: dict[str, Tensor]) -> None:
    faulty = noisy(clean, 0.04)
    depth = {}
    for photometric in (False, True):
        preparation = Preparation(photometric=photometric)
        predictor = Predictor(rig, method="semi_global", level=5, min_depth=0.5, preparation=preparation)
        truth = predictor(clean).index
        depth[photometric] = (predictor(faulty).index - truth).abs().mean()
        if not photometric:
            assert predictor(faulty).compensations == ()
            continue
        (said,), (nothing,) = predictor(faulty).compensations, predictor(clean).compensations
        assert list(said.noise) == list(rig.names)
        assert all(amount == pytest.approx(0.04, rel=0.15) for amount in said.noise.values())
        assert nothing == Compensation(dict.fromkeys(rig.names, 0.0), None)
    assert depth[True] < 0.9 * depth[False]


def test_the_light_that_is_told_is_that_which_is_taken_out(rig: CameraRig, clean: dict[str, Tensor]) -> None:
    """It is estimated of smooth images: noise is cut off at black, which looks like light."""
    dark = noisy({name: image * (0.3 if name == "cam1" else 1.0) for name, image in clean.items()}, 0.06)
    predictor = Predictor(rig, method="semi_global", level=5, min_depth=0.5)
    batch = {name: torch.stack((image, clean[name])) for name, image in dark.items()}
    said, nothing = predictor(batch).compensations
    assert nothing.light is None
    assert said.light is not None
    smooth = {name: denoised(image) for name, image in dark.items()}
    assert torch.equal(said.light.exposure, calibrate_photometry(rig, smooth).exposure)
    assert not torch.equal(said.light.exposure, calibrate_photometry(rig, dark).exposure)
    predictor.preparation = Preparation(photometric=False)
    even, _ = predictor.inputs(said.light.corrected(rig, smooth))
    predictor.preparation = Preparation()
    taken_out, _ = predictor.inputs(dark)
    torch.testing.assert_close(taken_out, even, atol=0.1, rtol=0)
    assert (taken_out - even).abs().mean() < 0.01


def test_a_lens_that_is_brighter_at_its_edge_loses_nothing() -> None:
    light = PhotometricCalibration(torch.zeros(1, 3), torch.tensor([[-0.02, 0.0]]), torch.tensor([1.6]), 0.0)
    assert "lose up to 0 %" in Compensation({}, light).described()[0]


@pytest.mark.parametrize("factor", [1 / 16, 1 / 64])
def test_dark_pictures_give_the_depth_of_bright_ones(
    rig: CameraRig, clean: dict[str, Tensor], factor: float
) -> None:
    """Of 12 or 10 bits in 16, and of scenes at night; frames of a batch are judged one by one."""
    predictor = Predictor(rig, method="semi_global", level=4, min_depth=0.5)
    batch = {name: torch.stack((image, image * factor)) for name, image in clean.items()}
    depth = predictor(batch)
    bright, dark = depth.compensations
    assert bright.gain == 1
    assert dark.gain == pytest.approx(1 / factor, rel=0.5)
    assert any("brightens" in sentence for sentence in dark.described())
    assert (depth.index[0] - depth.index[1]).abs().mean() < 0.2
    black = predictor({name: torch.zeros_like(image) for name, image in clean.items()})
    assert black.compensations[0].gain == 1
