# SPDX-License-Identifier: Apache-2.0
"""The edge of image circles, found in images: where it is clear, to a degree; else nothing is cut off."""

from __future__ import annotations

import math

import pytest
import torch

from sphericalvision.cameras import CameraRig, FisheyeCamera, ring_rig
from sphericalvision.capture.preparation.dark_surround import dark_beyond, without_dark_surround
from sphericalvision.scenes import make_scene, render_rig

WIDE = FisheyeCamera.from_field_of_view((160, 200), math.radians(220))


def circle(angle_deg: float, offset: float = 0.0) -> torch.Tensor:
    """Distance in degrees inside a circle of the image of ``WIDE``, around a centre that is off by pixels."""
    v, u = torch.meshgrid(torch.arange(160.0), torch.arange(200.0), indexing="ij")
    return angle_deg - (u - 99.5 - offset).hypot(v - 79.5) * 110 / 80


@pytest.mark.parametrize("half_angle", [80, 95, 110])
def test_rendered_circles_end_where_lenses_do(half_angle: int) -> None:
    rig = ring_rig(3, 0.2, (200, 200), math.radians(2 * half_angle))
    frames = [render_rig(make_scene("room", seed=seed), rig, 1) for seed in (1, 2)]
    cameras = {name: camera.with_max_angle(math.radians(137)) for name, camera in rig.cameras.items()}
    result, angles = without_dark_surround(rig.replaced(cameras), frames)
    for name in rig.names:
        assert math.degrees(angles[name]) == pytest.approx(half_angle, abs=1.01)
        assert float(result.cameras[name].max_angle) == pytest.approx(angles[name])
    assert without_dark_surround(rig, frames) == (rig, {})


def test_black_levels_noise_and_an_eccentric_circle_are_no_obstacle() -> None:
    generator = torch.Generator().manual_seed(0)
    inside = circle(95, offset=2.0) > 0
    image = torch.where(inside, 0.2 + 0.6 * torch.rand(3, 160, 200, generator=generator), 0.02)
    image = image + 0.01 * torch.randn(3, 160, 200, generator=generator)
    angle = dark_beyond(WIDE, [image])
    assert angle is not None
    assert math.degrees(angle) == pytest.approx(94, abs=2)


def test_what_is_not_clear_is_left_alone() -> None:
    bright = torch.full((3, 160, 200), 0.5)
    edge = bright * (circle(90) > 0)
    fading = bright * (circle(110) / 60).clamp(0, 1)  # vignetting
    night = edge * 0.1
    overlay = edge.clone()
    overlay[:, 140:150, 90:110] = 1.0  # a date in the dark part
    for images in ([bright], [fading], [night], [overlay], [edge, bright], [0 * bright]):
        assert dark_beyond(WIDE, images) is None
    masked = CameraRig({"wide": WIDE}, torch.eye(4)[None], {"wide": circle(90) > 0})  # already
    assert without_dark_surround(masked, [{"wide": edge}]) == (masked, {})
    angle = dark_beyond(WIDE, [edge])
    assert angle is not None
    assert math.degrees(angle) == pytest.approx(90, abs=2)
