# SPDX-License-Identifier: Apache-2.0
"""Metrics and losses weighted by solid angle: integrals known in closed form, plain loops, masks, processes."""

import math

import pytest
import torch
from torch import Tensor

from sphericalvision.icosphere import Icosphere
from sphericalvision.losses import solid_angle_mean
from sphericalvision.metrics import SolidAngleIoU, SolidAngleMean, angular_error
from sphericalvision.sphere import Cubemap, Equirectangular, Healpix, SphereGrid

GRIDS = [Equirectangular(32, 64), Icosphere(4), Cubemap(24), Healpix(16)]


def ids(grid: SphereGrid) -> str:
    return type(grid).__name__


@pytest.mark.parametrize("grid", GRIDS, ids=ids)
def test_means_are_those_of_the_sphere(grid: SphereGrid) -> None:
    """The mean of y² is 1/3 and of |x| 1/2, whatever the grid."""
    x, y, _ = grid.directions.unbind(-1)
    metric = SolidAngleMean(grid)
    metric.update(torch.stack((y.square(), y.square())))
    assert metric.compute().item() == pytest.approx(1 / 3, rel=5e-3)
    values = solid_angle_mean(torch.stack((y.square(), x.abs())), grid.solid_angles)
    assert values.tolist() == pytest.approx([1 / 3, 1 / 2], rel=5e-3)


def loop_mean(values: Tensor, weights: Tensor, mask: Tensor) -> float:
    """Point by point."""
    total = weight = 0.0
    for v, w, m in zip(values.tolist(), weights.tolist(), mask.tolist(), strict=True):
        if m:
            total, weight = total + v * w, weight + w
    return total / weight if weight else math.nan


def test_masked_means_equal_loops_and_empty_images_are_out(generator: torch.Generator) -> None:
    grid = Equirectangular(6, 12)
    values = torch.rand(4, 6, 12, generator=generator)
    mask = torch.rand(4, 6, 12, generator=generator) > torch.tensor([0.0, 0.5, 0.9, 1.0]).view(4, 1, 1)
    values[~mask] = torch.nan
    weights = grid.solid_angles.flatten()
    rows = [loop_mean(v, weights, m) for v, m in zip(values.flatten(1), mask.flatten(1), strict=True)]
    metric = SolidAngleMean(grid)
    metric.update(values[:1], mask[:1])
    metric.update(values[1:], mask[1:])
    assert metric.compute().item() == pytest.approx(sum(rows[:3]) / 3, rel=1e-5)
    assert metric.state_dict() == {}
    assert solid_angle_mean(values, grid.solid_angles, mask).tolist() == pytest.approx(
        [*rows[:3], 0.0], rel=1e-5
    )


def test_segmentation_equals_loops(generator: torch.Generator) -> None:
    grid = Equirectangular(6, 12)
    pred, target = torch.randint(0, 3, (2, 2, 6, 12), generator=generator)
    target[0, 0] = 255
    mask = torch.rand(2, 6, 12, generator=generator) > 0.2
    metric = SolidAngleIoU(grid, num_classes=4, ignore_index=255)
    metric.update(pred[:1], target[:1], mask[:1])
    metric.update(pred[1:], target[1:], mask[1:])
    weights = grid.solid_angles.expand(2, 6, 12)
    counts = mask & (target != 255)
    ious = []
    for label in range(4):
        both = weights[counts & (pred == label) & (target == label)].sum()
        either = weights[counts & ((pred == label) | (target == label))].sum()
        ious.append((both / either).item())
    result = metric.compute()
    assert result["IoU"].tolist() == pytest.approx(ious, nan_ok=True, rel=1e-5)
    assert result["IoU"][3].isnan()  # a class that does not occur
    assert result["mIoU"].item() == pytest.approx(sum(ious[:3]) / 3, rel=1e-5)
    right = weights[counts & (pred == target)].sum() / weights[counts].sum()
    assert result["accuracy"].item() == pytest.approx(right.item(), rel=1e-5)


def test_angles_between_directions_are_exact_where_they_are_small() -> None:
    angle = torch.tensor([0.0, 1e-4, 1.0, math.pi])
    tilted = torch.stack((torch.zeros(4), -angle.sin(), angle.cos()), -1)
    torch.testing.assert_close(
        angular_error(3 * tilted, torch.tensor([0.0, 0.0, 1.0])), angle, rtol=1e-5, atol=1e-6
    )
