# SPDX-License-Identifier: Apache-2.0
"""Exposure and vignetting of cameras, found again from what they see together."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from sphericalvision.cameras import CameraRig, EquirectangularCamera, PinholeCamera, ring_rig
from sphericalvision.capture import calibrate_photometry
from sphericalvision.capture.preparation.photometry import Photometer, _held
from sphericalvision.capture.preparation.preparation import Compensator, differs
from sphericalvision.scenes import make_scene, render_rig
from sphericalvision.scenes.disturbances import vignetted

GAINS = (1.0, 0.8, 1.1, 0.9)


@pytest.fixture(scope="module")
def rig() -> CameraRig:
    return ring_rig(4, image_size=(48, 56))


def faulty(rig: CameraRig, loss: float = 0.5) -> dict[str, torch.Tensor]:
    """A grey world through lenses that lose light, at different exposures, red and blue the other way round."""
    images = {}
    for (name, camera), gain in zip(rig.cameras.items(), GAINS, strict=True):
        channels = torch.tensor([gain, 1.0, 1 / gain]).view(3, 1, 1)
        images[name] = vignetted(torch.full((3, *camera.image_size), 0.5), camera, loss) * channels
    return images


def test_exposure_and_vignetting_are_found_again(rig: CameraRig) -> None:
    found = calibrate_photometry(rig, faulty(rig))
    gains = torch.tensor(GAINS).log()
    expected = torch.stack((gains, torch.zeros(4), -gains), 1)
    expected = expected - expected.mean(0)
    torch.testing.assert_close(found.exposure - found.exposure.mean(0), expected, atol=0.01, rtol=0)
    edges = found.light(found.edge[:, None])[..., 0] / found.light(torch.zeros(4, 1))[..., 0]
    assert (edges - 0.5 ** (1 / 2.2)).abs().max() < 0.01
    assert found.residual < 0.02


def test_corrected_images_are_alike(rig: CameraRig) -> None:
    images = faulty(rig)
    even = calibrate_photometry(rig, images).corrected(rig, images)
    for camera, image in zip(rig.cameras.values(), even.values(), strict=True):
        seen = camera.unproject(camera.pixel_grid()).valid
        assert image[:, seen].std(1).max() < 0.01


def test_cameras_without_a_fault_are_left_alone(rig: CameraRig) -> None:
    colors = torch.tensor([0.7, 0.4, 0.2]).view(3, 1, 1).expand(3, 48, 56)
    found = calibrate_photometry(rig, dict.fromkeys(rig.names, colors))
    assert found.strength < 1e-5


def test_what_a_mask_hides_does_not_count(rig: CameraRig) -> None:
    images = faulty(rig)
    mask = torch.ones(48, 56, dtype=torch.bool)
    mask[:, :40] = False
    images["cam2"] = images["cam2"].where(mask, 0.9)
    masked = calibrate_photometry(CameraRig(rig.cameras, rig.world_from_camera, {"cam2": mask}), images)
    clean = calibrate_photometry(rig, faulty(rig))
    torch.testing.assert_close(masked.exposure, clean.exposure, atol=0.02, rtol=0)
    unmasked = calibrate_photometry(rig, images)
    assert (unmasked.exposure - clean.exposure).abs().max() > 0.1


def test_a_batch_of_frames_counts_as_one(rig: CameraRig) -> None:
    images = faulty(rig)
    twice = {name: torch.stack((image, image)) for name, image in images.items()}
    one, two = calibrate_photometry(rig, images), calibrate_photometry(rig, twice)
    torch.testing.assert_close(one.falloff, two.falloff, atol=1e-4, rtol=1e-3)
    assert one.corrected(rig, twice)["cam1"].shape == (2, 3, 48, 56)


def test_cameras_that_share_no_view_say_nothing() -> None:
    lens = PinholeCamera.from_field_of_view((24, 32), math.radians(60))
    half_turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    apart = CameraRig({"front": lens, "back": lens}, torch.stack((torch.eye(4), half_turn)))
    found = calibrate_photometry(
        apart, {"front": torch.full((3, 24, 32), 0.2), "back": torch.full((3, 24, 32), 0.8)}
    )
    assert found.strength == 0


def test_panoramas_have_exposure_but_no_vignetting() -> None:
    lens = EquirectangularCamera((16, 32))
    rig = CameraRig({"one": lens, "other": lens}, torch.eye(4).expand(2, 4, 4))
    images = {"one": torch.full((3, 16, 32), 0.4), "other": torch.full((3, 16, 32), 0.5)}
    found = calibrate_photometry(rig, images)
    assert found.falloff.abs().max() == 0
    factor = (found.exposure[1] - found.exposure[0]).exp()
    torch.testing.assert_close(factor, torch.full((3,), 1.25), atol=0.01, rtol=0)


def test_saturated_and_black_values_do_not_count(rig: CameraRig) -> None:
    """Cut off at white and black, half of the sphere is the same in all cameras, whatever their exposure."""
    images = {}
    for (name, camera), gain in zip(rig.cameras.items(), GAINS, strict=True):
        pose = rig.world_from_camera[rig.names.index(name), :3, :3]
        directions = camera.unproject(camera.pixel_grid()).directions @ pose.mT
        x = directions[..., 0]
        brightness = torch.where(x > 0.3, 9.0, torch.where(x < -0.3, 0.0, 0.5))
        images[name] = (brightness * gain).clamp(0, 1).expand(3, -1, -1)
    found = calibrate_photometry(rig, images)
    gains = torch.tensor(GAINS).log()
    torch.testing.assert_close(found.exposure[:, 0], gains - gains.mean(), atol=0.01, rtol=0)


def test_what_cameras_see_differently_has_little_influence(rig: CameraRig) -> None:
    """A fifth of a picture shows something else: outliers, which the weights are for."""
    images = faulty(rig)
    images["cam3"][:, :, :10] = 0.9
    clean, found = calibrate_photometry(rig, faulty(rig)), calibrate_photometry(rig, images)
    torch.testing.assert_close(found.exposure, clean.exposure, atol=0.02, rtol=0)


@pytest.mark.parametrize("far", [10.0, 100.0])
def test_cameras_are_compared_where_they_agree_best(far: float) -> None:
    """A pattern on a sphere of 10 or of 100 radii: at the other distance the points of two cameras differ."""
    rig = ring_rig(4, radius=0.2, image_size=(96, 96))
    images = {}
    for place, (name, camera) in enumerate(rig.cameras.items()):
        pose = rig.world_from_camera[place, :3, :3]
        directions = camera.unproject(camera.pixel_grid()).directions @ pose.mT
        offset = rig.positions[place] - rig.center
        along = directions @ offset
        reach = (along.square() - offset.square().sum() + (0.2 * far) ** 2).sqrt() - along
        points = offset + directions * reach[..., None]
        pattern = 0.5 + 0.3 * torch.sin(points / (0.2 * far) * 25).prod(-1)
        images[name] = pattern.nan_to_num(0.5).clamp(0, 1).expand(3, -1, -1)
    residuals = {
        each: calibrate_photometry(rig, images, depth=0.2 * each).residual for each in (10.0, 30.0, 100.0)
    }
    assert min(residuals, key=residuals.__getitem__) == far
    assert calibrate_photometry(rig, images).residual == pytest.approx(residuals[far], rel=1e-6)


def test_large_images_are_compared_when_reduced(rig: CameraRig) -> None:
    large = rig.resized((480, 560))
    found, like = calibrate_photometry(large, faulty(large)), calibrate_photometry(rig, faulty(rig))
    torch.testing.assert_close(found.exposure, like.exposure, atol=0.01, rtol=0)
    torch.testing.assert_close(found.strength, like.strength, atol=0.02, rtol=0)


def test_an_unsure_difference_is_left_alone(rig: CameraRig) -> None:
    """Little is left of a picture with too much contrast: what it tells of lenses is half as large as its spread."""
    fine = rig.resized((192, 224))
    frame = render_rig(make_scene("rough", seed=1007), fine, 2)
    images = {name: ((image - 0.3) * 1.6 + 0.3).clamp(0, 1) for name, image in frame.items()}
    found = calibrate_photometry(fine, images)
    assert found.strength > 0.2
    assert found.spread > 0.1
    assert not differs(Compensator(fine).light(images))
    assert differs(Compensator(rig).light(faulty(rig)))


def test_normal_equations_are_those_of_all_rows_and_the_spread_is_the_jackknifes() -> None:
    """Row by row, in numpy: each of which says how two cameras differ at a point; eight rounds of Cauchy's weights."""
    rig = ring_rig(2, image_size=(48, 48))
    generator = torch.Generator().manual_seed(0)
    images = {
        name: (image[:1] + 0.1 * torch.rand(1, 48, 48, generator=generator)).clamp(0, 1)
        for name, image in render_rig(make_scene("room", seed=1), rig).items()
    }
    photometer = Photometer(rig, depth=2.0)
    points, estimate = photometer._points, photometer.estimate(images)
    frames = [images[name][None] * photometer._inside[name] for name in rig.names]
    values = torch.stack([look(frame)[0, 0] for look, frame in zip(points.lookups, frames, strict=True)])
    values = (values / points.share.clamp(min=0.5))[:, points.columns[0]].double().numpy()
    used = points.usable[0, 0, 0].numpy() & (values > 0.04).all(0) & (values < 0.97).all(0)
    one, *falloffs = points.rows[0, 0].numpy()  # of the cameras 2 and 1: 1, minus and plus their falloffs
    rows = np.stack((-one, one, *falloffs[2:], *falloffs[:2]), 1)[used]
    difference = np.log(values[1] / values[0])[used]
    part = points.parts[0].argmax(0).numpy()[used]
    like = torch.zeros((), dtype=torch.float64)
    hold = _held(2, 1, like).numpy() * len(rows) / 6
    found, scale = np.zeros(6), 0.3
    for _ in range(8):
        weights = 1 / (1 + ((difference - rows @ found) / scale) ** 2)
        normal, right = rows.T * weights @ rows + hold * weights.mean(), rows.T @ (weights * difference)
        found = np.linalg.solve(normal, right)
        scale = max(0.01, 1.4826 * np.quantile(abs(difference - rows @ found), 0.5, method="lower"))
    np.testing.assert_allclose(estimate.exposure[:, 0], found[:2], atol=1e-5)
    np.testing.assert_allclose(estimate.falloff.flatten(), found[2:], atol=1e-5)
    assert estimate.residual.item() == pytest.approx(scale, rel=1e-5)

    def ends(answer: np.ndarray) -> np.ndarray:
        return np.exp(np.concatenate((answer[:2], answer[:2] - answer[2:].reshape(2, 2).sum(1))))

    without = []
    for each in np.unique(part):
        here = part == each
        less = normal - rows[here].T * weights[here] @ rows[here]
        without.append(ends(np.linalg.solve(less, right - rows[here].T @ (weights * difference)[here])))
    # Two cameras differ from their mean by as much: which of them is taken is a matter of rounding.
    spreads = np.sqrt((len(without) - 1) * np.var(without, 0))
    assert min(abs(estimate.spread.item() / spreads - 1)) < 1e-4
    assert estimate.strength.item() == pytest.approx(abs(ends(found) - 1).max(), rel=1e-5)
