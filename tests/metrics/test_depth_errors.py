# SPDX-License-Identifier: Apache-2.0
"""Metrics against their definitions, written out in plain loops."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from sphericalvision.metrics import (
    DepthError,
    DepthIndexError,
    LeftRightError,
    StereoError,
    depth_error,
    depth_index_error,
)


def loop_index_errors(pred: Tensor, target: Tensor, mask: Tensor, number: int) -> dict[str, float]:
    """Do the protocol image by image, point by point."""
    rows = []
    for image in range(len(pred)):
        points = [
            100 * abs(p - t) / number
            for p, t, m in zip(
                pred[image].tolist(), target[image].tolist(), mask[image].tolist(), strict=True
            )
            if m
        ]
        if points:
            above = [100 * sum(e > threshold for e in points) / len(points) for threshold in (1, 3, 5)]
            rows.append(
                [*above, sum(points) / len(points), math.sqrt(sum(e * e for e in points) / len(points))]
            )
    means = [sum(column) / len(column) for column in zip(*rows, strict=True)]
    return dict(zip((">1", ">3", ">5", "MAE", "RMS"), means, strict=True))


def index_batch(generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    target = 31 * torch.rand(4, 162, generator=generator)
    pred = target + 1.5 * torch.randn(4, 162, generator=generator)
    # The last is empty
    mask = torch.rand(4, 162, generator=generator) > torch.tensor([[0.0], [0.5], [0.9], [1.0]])
    return pred, target, mask


def plain(metrics: dict[str, Tensor]) -> dict[str, float]:
    return {name: value.item() for name, value in metrics.items()}


def test_depth_index_error_equals_loops(generator: torch.Generator) -> None:
    pred, target, mask = index_batch(generator)
    metric = DepthIndexError(num_hypotheses=32)
    metric.update(pred[:1], target[:1], mask[:1])
    metric.update(pred[1:], target[1:], mask[1:])
    assert plain(metric.compute()) == pytest.approx(loop_index_errors(pred, target, mask, 32), rel=1e-5)


def test_thresholds_are_strict() -> None:
    """An error of exactly 1, 3 or 5 % is not above."""
    target = torch.zeros(1, 4)
    errors = plain(depth_index_error(torch.tensor([[1.0, 3.0, 5.0, 6.0]]), target, num_hypotheses=100))
    assert (errors[">1"], errors[">3"]) == (75.0, 50.0)
    assert errors[">5"] == 25.0


def test_depth_error_equals_its_definition(generator: torch.Generator) -> None:
    target = 0.5 + 9 * torch.rand(2, 60, generator=generator)
    pred = target * (0.4 * torch.randn(2, 60, generator=generator)).exp()
    mask = torch.rand(2, 60, generator=generator) > 0.3
    rows = []
    for p, t, m in zip(pred, target, mask, strict=True):
        p, t = p[m], t[m]
        inliers = (torch.maximum(p / t, t / p) < 1.25).float()
        rows.append(torch.stack((((p - t).abs() / t).mean(), (p - t).square().mean().sqrt(), inliers.mean())))
    metric = DepthError()
    metric.update(pred, target, mask)
    assert list(plain(metric.compute()).values()) == pytest.approx(
        torch.stack(rows).mean(0).tolist(), rel=1e-5
    )


def test_depth_error_at_infinity() -> None:
    """True infinity is left out; a prediction at infinity counts as the largest depth."""
    target = torch.tensor([[torch.inf, 10.0, 500.0]])
    pred, metric = torch.tensor([[1.0, 8e6, 1.0]]), DepthError()
    metric.update(pred, target)
    for errors in (depth_error(pred, target), metric.compute()):
        assert plain(errors) == {"AbsRel": pytest.approx(9.0), "RMSE": pytest.approx(90.0), "d<1.25": 0.0}


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_many_images_in_half_precision_are_summed_up_in_double(
    dtype: torch.dtype, generator: torch.Generator
) -> None:
    target = torch.rand(2, 5000, generator=generator).to(dtype)
    pred = (target + torch.randn(2, 5000, generator=generator) / 64).to(dtype)
    metric, expected = DepthIndexError(192), DepthIndexError(192)
    for _ in range(100):
        metric.update(pred, target)
    expected.update(pred.double(), target.double())
    torch.testing.assert_close(metric.compute(), expected.compute())


def test_both_metrics_are_those_of_plain_numpy() -> None:
    rng = np.random.default_rng(1)
    pred, target = rng.uniform(1, 9, (2, 3, 4, 6)).astype(np.float32)
    target[rng.uniform(size=target.shape) < 0.3] = 0
    target[2] = 0  # an image without truth counts nowhere
    known = target > 0
    expected: dict[str, list[float]] = {"MAE": [], "RMSE": [], "MARE": [], "LRCE": []}
    for p, t, k in zip(pred[:2], target[:2], known[:2], strict=True):
        e = np.abs(p[k] - t[k])
        expected["MAE"].append(e.mean())
        expected["RMSE"].append(np.sqrt((e**2).mean()))
        expected["MARE"].append((e / t[k]).mean())
        rows = k[:, 0] & k[:, -1]
        if rows.any():
            steps = (t[rows, 0] - t[rows, -1]) - (p[rows, 0] - p[rows, -1])
            expected["LRCE"].append(np.abs(steps).mean())
    found = {}
    for metric in (StereoError(), LeftRightError()):
        metric.update(torch.from_numpy(pred), torch.from_numpy(target))
        found |= {name: value.item() for name, value in metric.compute().items()}
    assert found == pytest.approx({name: np.mean(values) for name, values in expected.items()}, rel=1e-5)
