# SPDX-License-Identifier: Apache-2.0
"""The extended unified model against the unified one, bisection past 90° and a real calibration."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import (
    ExtendedUnifiedCamera,
    UnifiedCamera,
    project_extended_unified,
    unproject_extended_unified,
)

# TUM-VI, the left lens at 512 x 512, as Basalt calibrated it.
TUM_FOCAL, TUM_CENTER = [191.14799836282189, 191.13150963902818], [254.9585771534443, 256.88154645599448]
TUM_ALPHA, TUM_BETA = 0.6291060881178562, 1.0418067381860868


def published(name: str) -> Path:
    """A calibration that others publish; it is not part of this package."""
    default = Path(__file__).resolve().parents[2].parent / "shared" / "real"
    path = Path(os.environ.get("SPHERICALVISION_REAL", default)) / "calibrations" / name
    if not path.is_file():
        pytest.skip("published calibrations not found; set SPHERICALVISION_REAL to the folder that has them")
    return path


def double(*values: float | list[float]) -> list[Tensor]:
    return [torch.tensor(value, dtype=torch.float64) for value in values]


def lens(alpha: float = TUM_ALPHA, beta: float = TUM_BETA) -> ExtendedUnifiedCamera:
    return ExtendedUnifiedCamera(*double(TUM_FOCAL, TUM_CENTER, alpha, beta), (512, 512))


def circle(angle: Tensor, azimuth: float = 0.7) -> Tensor:
    """Unit vectors (*, 3) at angles (*) from the axis."""
    flat = angle.sin()
    return torch.stack((flat * math.cos(azimuth), flat * math.sin(azimuth), angle.cos()), -1)


@pytest.mark.parametrize("xi", [0.0, 0.4, 1.0, 2.5])
def test_with_beta_one_it_is_the_unified_model(xi: float, generator: torch.Generator) -> None:
    """α = ξ / (1 + ξ), and f is γ / (1 + ξ)."""
    points = torch.randn(300, 3, generator=generator, dtype=torch.float64)
    focal, center = double(TUM_FOCAL, TUM_CENTER)
    unified = UnifiedCamera((1 + xi) * focal, center, double(xi)[0], None, (512, 512))
    camera = lens(xi / (1 + xi), 1.0)
    pixels, valid = camera.project(points)
    expected = unified.project(points)
    assert torch.equal(valid, expected.valid)
    torch.testing.assert_close(pixels[valid], expected.pixels[valid], rtol=0, atol=1e-10)
    assert camera.max_angle.item() == pytest.approx(unified.max_angle.item(), abs=1e-7)
    back, back_valid = camera.unproject(pixels)
    assert back_valid[valid].all()
    torch.testing.assert_close(
        back[valid], torch.nn.functional.normalize(points, dim=-1)[valid], rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("degrees", [1e-5, 45.0, 90.0, 97.0, 105.0])
def test_past_90_degrees_against_bisection(degrees: float) -> None:
    """The radius by the formula in plain Python, and the angle of a radius by bisection."""

    def radius(angle: float) -> float:
        d = math.sqrt(TUM_BETA * math.sin(angle) ** 2 + math.cos(angle) ** 2)
        return TUM_FOCAL[0] * math.sin(angle) / (TUM_ALPHA * d + (1 - TUM_ALPHA) * math.cos(angle))

    angle, camera = math.radians(degrees), lens()
    pixels = camera.project(circle(double(angle)[0], 0.0)).pixels
    assert (pixels[0] - TUM_CENTER[0]).item() == pytest.approx(radius(angle), abs=1e-10)
    low, high = 0.0, camera.max_angle.item()
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if radius(middle) < pixels[0].item() - TUM_CENTER[0] else (low, middle)
    x, _, z = unproject_extended_unified(pixels, *camera._aligned(pixels)).directions.tolist()
    assert math.atan2(x, z) == pytest.approx(low, abs=1e-12)


@pytest.mark.parametrize(("alpha", "beta"), [(0.3, 1.4), (0.5, 0.8), (0.63, 1.04), (0.8, 2.0), (1.0, 0.5)])
def test_ends_exactly_where_the_radius_stops_growing(alpha: float, beta: float) -> None:
    """Found by scanning the formula: up to its pole, or its maximum."""
    angle = torch.linspace(0, math.pi, 20001, dtype=torch.float64)[1:-1]
    denominator = alpha * torch.sqrt(beta * angle.sin() ** 2 + angle.cos() ** 2) + (1 - alpha) * angle.cos()
    radius = angle.sin() / denominator
    growing = (radius.diff(prepend=radius.new_zeros(1)) > 0) & (denominator > 0)
    points, camera = circle(angle) * 3.0, lens(alpha, beta)
    valid = project_extended_unified(points, *camera._aligned(points)).valid
    assert (valid != growing.long().cumprod(0).bool()).sum() <= 1
    assert camera.max_angle.item() == pytest.approx(
        angle[growing.long().cumprod(0).bool()].max().item(), abs=2e-4
    )


def test_tum_vi_file() -> None:
    """The numbers above are those of the file."""
    first = json.loads(published("tumvi_512_basalt_eucm.json").read_text())["value0"]["intrinsics"][0]
    names = ["fx", "fy", "cx", "cy", "alpha", "beta"]
    written = [*TUM_FOCAL, *TUM_CENTER, TUM_ALPHA, TUM_BETA]
    assert [first["intrinsics"][name] for name in names] == written


def test_pixels_beyond_the_model_are_reported() -> None:
    """For α > 1/2 the image ends at the radius 1 / √(β (2α − 1))."""
    camera = lens(0.75, 2.0)
    radius = torch.tensor([0.999, 1.001, 30.0], dtype=torch.float64)
    pixels = double(TUM_CENTER)[0] + radius.unsqueeze(-1) * double([TUM_FOCAL[0], 0.0])[0]
    directions, valid = unproject_extended_unified(pixels, *camera._aligned(pixels))
    assert valid.tolist() == [True, False, False]
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(3, dtype=torch.float64))


def test_impossible_intrinsics_are_refused() -> None:
    with pytest.raises(ValueError, match=r"alpha: expected numbers in \[0, 1\], got 1.5"):
        lens(1.5)
    with pytest.raises(ValueError, match=r"beta: expected numbers above 0, got 0.0"):
        lens(0.5, 0.0)
