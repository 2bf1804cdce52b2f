# SPDX-License-Identifier: Apache-2.0
"""Other cameras as OCam models: within the stated residual, both ways."""

import math

import pytest
import torch

from sphericalvision.cameras import (
    DoubleSphereCamera,
    FisheyeCamera,
    OCamCamera,
    convert,
)
from sphericalvision.core import ArgumentError
from sphericalvision.data.omnistereo import writer
from sphericalvision.data.omnistereo.writer import ocam_from_camera


def cameras() -> dict[str, object]:
    return {
        "equidistant": FisheyeCamera.from_field_of_view((800, 768), math.radians(220)),
        "equisolid": FisheyeCamera.from_field_of_view((800, 768), math.radians(220), projection="equisolid"),
        "stereographic": FisheyeCamera.from_field_of_view(
            (800, 768), math.radians(185), projection="stereographic"
        ),
        "two scales": FisheyeCamera(
            "equidistant", [200.0, 210.0], [390.0, 401.5], (800, 768), math.radians(100)
        ),
        "double sphere": DoubleSphereCamera(
            [300.0, 300.0], [610.0, 600.0], -0.2, 0.6, (1216, 1216), math.radians(100)
        ),
    }


@pytest.mark.parametrize("name", list(cameras()))
def test_the_fit_images_alike_both_ways(name: str, generator: torch.Generator) -> None:
    camera = cameras()[name].to(torch.float64)
    residual = 0.02
    ocam = ocam_from_camera(camera, max_residual=residual)
    points = torch.randn(4000, 3, dtype=torch.float64, generator=generator)
    expected = camera.project(points)
    gap = (ocam.project(points).pixels - expected.pixels)[expected.valid].norm(dim=-1)
    assert gap.max() <= residual + 1e-6
    rays = ocam.unproject(expected.pixels[expected.valid]).directions
    again = (camera.project(rays).pixels - expected.pixels[expected.valid]).norm(dim=-1)
    assert again.max() <= 1.5 * residual + 1e-6


def test_complete_ocam_cameras_pass_and_incomplete_ones_are_completed() -> None:
    complete = ocam_from_camera(cameras()["equidistant"])
    assert ocam_from_camera(complete) is complete
    incomplete = OCamCamera(
        complete.polynomial,
        None,
        complete.principal_point,
        torch.tensor([1.0003, -0.00027, -0.00092], dtype=torch.float64),
        complete.image_size,
        complete.max_angle,
    )
    completed = ocam_from_camera(incomplete, max_residual=0.01)
    assert torch.equal(completed.polynomial, incomplete.polynomial)
    assert torch.equal(completed.affine, incomplete.affine)


def test_a_fit_without_the_corners_of_images_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = FisheyeCamera("equidistant", [100.0, 100.0], [99.5, 49.5], (100, 200), 1.0)
    monkeypatch.setattr(writer, "convert", lambda *a, **k: convert(*a, **k)._replace(covered_angle=0.8))
    with pytest.raises(ArgumentError, match="sees"):
        ocam_from_camera(camera)
