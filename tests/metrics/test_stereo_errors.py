# SPDX-License-Identifier: Apache-2.0
"""Helvipad's metrics against plain numpy."""

import numpy as np
import pytest
import torch

from sphericalvision.metrics import LeftRightError, StereoError


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
