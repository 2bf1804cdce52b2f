# SPDX-License-Identifier: Apache-2.0
"""What every metric keeps, whatever the values: NaN is wrong, never right; what does not count has no influence."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torchmetrics import Metric

from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import Icosphere
from sphericalvision.losses import depth_index_huber, solid_angle_mean
from sphericalvision.metrics import (
    ByRegion,
    DepthError,
    DepthIndexError,
    LeftRightError,
    OmniMVSError,
    SolidAngleIoU,
    SolidAngleMean,
    StereoError,
    angular_error,
)
from sphericalvision.metrics.averages import MeanOverImages
from sphericalvision.metrics.spread import bootstrap_interval, error_of_surest

METRICS: dict[str, tuple[Callable[[], Metric], tuple[int, ...]]] = {
    "index": (lambda: DepthIndexError(16), (32,)),
    "depth": (lambda: DepthError(max_depth=10.0), (32,)),
    "stereo": (StereoError, (32,)),
    "stereo panoramas": (StereoError, (4, 8)),
    "left-right": (LeftRightError, (4, 8)),
    "official": (lambda: OmniMVSError(min_depth=0.5), (4, 8)),
    "regions": (lambda: ByRegion(DepthIndexError(16), {"first half": torch.arange(32) < 16}), (32,)),
}
WEIGHTED = ["index", "depth", "stereo", "stereo panoramas", "regions"]
POINT = 8
"""Of 32: in the band of the official protocol, in the first column, in the first half."""

every_metric = pytest.mark.parametrize("name", METRICS)


def batch(name: str) -> tuple[Tensor, Tensor]:
    """Two images, predicted and true, 0.5 to 1.5 everywhere and never further apart than 0.1."""
    generator = torch.Generator().manual_seed(3)
    target = 0.5 + torch.rand(2, 32, generator=generator)
    pred = target + 0.1 * torch.rand(2, 32, generator=generator)
    return (values.view(2, *METRICS[name][1]) for values in (pred, target))  # type: ignore[return-value]


def at_point(values: Tensor, value: float | bool) -> Tensor:
    """The values with another one at ``POINT`` of the first image."""
    changed = values.clone()
    changed.view(2, 32)[0, POINT] = value
    return changed


def errors(name: str, *arguments: Tensor | None, **options: Tensor) -> dict[str, float]:
    metric = METRICS[name][0]()
    metric.update(*arguments, **options)
    return {key: value.item() for key, value in metric.compute().items()}


def everywhere(values: Tensor) -> Tensor:
    return torch.ones_like(values, dtype=torch.bool)


@every_metric
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -3.0, 0.0])
def test_what_is_no_depth_is_wrong(name: str, value: float) -> None:
    """It is as wrong as another wrong number where points are counted, and never better than the right one."""
    pred, target = batch(name)
    result, far = errors(name, at_point(pred, value), target), errors(name, at_point(pred, 9.0), target)
    for key, right in errors(name, target, target).items():
        assert not math.isnan(result[key]), key
        if key.rpartition("/")[2] == "d<1.25":
            assert result[key] == pytest.approx(far[key]) == pytest.approx(right - 1 / 64)
        else:
            assert result[key] > right, key
            assert not math.isnan(value) or ">" in key or result[key] == math.inf
        if ">" in key and name != "official" and value in (math.nan, math.inf, -math.inf):
            assert result[key] == pytest.approx(far[key]), key


@every_metric
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_truth_that_is_not_finite_is_left_out(name: str, value: float) -> None:
    pred, target = batch(name)
    masked = errors(name, pred, target, at_point(everywhere(target), False))
    assert errors(name, pred, at_point(target, value)) == masked
    assert errors(name, pred, at_point(target, value), everywhere(target)) == masked
    assert masked != errors(name, pred, target)


@every_metric
@pytest.mark.parametrize("value", [math.nan, math.inf, -7.0])
def test_values_outside_of_the_mask_have_no_influence(name: str, value: float) -> None:
    pred, target = batch(name)
    mask = at_point(everywhere(target), False)
    expected = errors(name, pred, target, mask)
    assert errors(name, at_point(pred, value), at_point(target, value), mask) == expected


@every_metric
def test_images_without_a_point_are_out_of_the_mean_and_others_are_not(name: str) -> None:
    pred, target = batch(name)
    first = everywhere(target)
    first[1] = False
    alone = METRICS[name][0]()
    alone.update(pred[:1], target[:1])
    expected = {key: value.item() for key, value in alone.compute().items()}
    assert errors(name, pred, target, first) == pytest.approx(expected)
    assert all(math.isnan(value) for value in errors(name, pred, target, ~everywhere(target)).values())
    broken = METRICS[name][0]()
    broken.update(torch.full_like(pred, math.nan), target)
    assert not any(value.isnan() for value in broken.compute().values())
    assert int(getattr(broken, "everywhere", broken).num_images) == 2


@every_metric
def test_calls_return_the_errors_of_a_batch_and_add_up(name: str) -> None:
    """As every metric of torchmetrics does, also where states of two are merged."""
    pred, target = batch(name)
    metric, merged, other = (METRICS[name][0]() for _ in range(3))
    for image in (slice(0, 1), slice(1, 2)):
        values = {key: value.item() for key, value in metric(pred[image], target[image]).items()}
        assert values == errors(name, pred[image], target[image])
        metric.compute()  # what it keeps is of no use after another call
    merged.update(pred[:1], target[:1])
    other.update(pred[1:], target[1:])
    merged.merge_state(other)
    expected = errors(name, pred, target)
    for computed in (metric.compute(), merged.compute()):
        assert {key: value.item() for key, value in computed.items()} == pytest.approx(expected)


@every_metric
@pytest.mark.parametrize("true", [2, 255, 0.5])
def test_masks_are_true_where_they_are_not_zero(name: str, true: float) -> None:
    pred, target = batch(name)
    mask = at_point(everywhere(target), False)
    numbers = mask * torch.tensor(true, dtype=torch.uint8 if isinstance(true, int) else None)
    assert errors(name, pred, target, numbers) == errors(name, pred, target, mask)


@every_metric
def test_weights_are_used_or_refused(name: str) -> None:
    pred, target = batch(name)
    grid = torch.ones(METRICS[name][1])
    if name not in WEIGHTED:
        with pytest.raises(ArgumentError, match="weights"):
            errors(name, pred, target, weights=grid)
        return
    plain = errors(name, pred, target)
    assert errors(name, pred, target, weights=7 * grid) == pytest.approx(plain)
    none = at_point(torch.ones_like(pred), 0.0)
    assert errors(name, pred, target, weights=none) == pytest.approx(
        errors(name, pred, target, at_point(everywhere(target), False))
    )
    of_grid = grid.clone()
    of_grid.view(-1)[POINT] = 0.0
    assert errors(name, pred, target, weights=of_grid) == pytest.approx(
        errors(name, pred, target, (of_grid > 0).expand(target.shape))
    )
    for value in (math.nan, math.inf, -1.0):
        wrong = at_point(torch.ones_like(pred), value)
        with pytest.raises(ArgumentError, match="weights"):
            errors(name, pred, target, weights=wrong)
        unseen = errors(name, pred, target, at_point(everywhere(target), False), weights=wrong)
        assert unseen == pytest.approx(
            errors(name, pred, target, at_point(everywhere(target), False)), nan_ok=False
        )


def test_the_farthest_truth_that_counts_is_max_depth() -> None:
    metric = DepthError(max_depth=10.0)
    target = torch.tensor([[10.0, math.nextafter(10.0, 11.0)]], dtype=torch.float64)
    metric.update(torch.tensor([[5.0, 1.0]], dtype=torch.float64), target)
    assert metric.compute()["AbsRel"].item() == pytest.approx(0.5)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_mean_over_the_sphere_hides_nothing(value: float) -> None:
    """One value that is no number spoils the mean; outside of the mask it has no influence."""
    grid = Icosphere(1)
    values = at_point(torch.ones(2, 42)[:, :32], value)
    values = torch.cat((values, torch.ones(2, 10)), 1)
    mean, masked = SolidAngleMean(grid), SolidAngleMean(grid)
    mean.update(values)
    assert not mean.compute().isfinite()
    masked.update(values, values.isfinite())
    assert masked.compute().item() == pytest.approx(1.0)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int8, torch.int16])
def test_labels_of_few_bits_count_as_those_of_many(dtype: torch.dtype) -> None:
    pred, target = torch.randint(100, (2, 3, 42), generator=torch.Generator().manual_seed(0))
    few, many = (SolidAngleIoU(Icosphere(1), 100, ignore_index=7) for _ in range(2))
    few.update(pred.to(dtype), target.to(dtype))
    many.update(pred, target)
    torch.testing.assert_close(few.compute(), many.compute(), rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("length", [1e-38, 1e-20, 1.0, 1e20, 1e38])
def test_angles_of_directions_of_every_length(length: float) -> None:
    ahead, aside = torch.tensor([0.0, 0.0, length]), torch.tensor([1.0, 0.0, 1.0])
    assert angular_error(ahead, aside).item() == pytest.approx(math.pi / 4)
    assert angular_error(aside, ahead).item() == pytest.approx(math.pi / 4)


@pytest.mark.parametrize("value", [0.0, math.nan, math.inf])
def test_what_is_no_direction_has_no_angle(value: float) -> None:
    assert angular_error(torch.full((3,), value), torch.ones(3)).isnan()
    assert angular_error(torch.ones(3), torch.full((3,), value)).isnan()


def test_the_surest_points_are_none_of_unknown_confidence() -> None:
    sure = torch.tensor([[math.nan, 0.2, 0.9]])
    errors = error_of_surest(torch.tensor([[8.0, 3.0, 1.0]]), sure, (0.34, 0.67, 1.0))
    assert errors.tolist() == [[1.0, 2.0, 4.0]]
    broken = error_of_surest(torch.tensor([[1.0, math.nan, 1.0]]), sure, (0.34, 0.67))
    assert broken.tolist() == [[1.0, math.inf]]


def test_an_interval_of_infinite_values_says_so() -> None:
    interval = bootstrap_interval([1.0, math.inf, 2.0, 3.0])
    assert interval.mean == interval.high == math.inf
    assert not math.isnan(interval.low)


@pytest.mark.parametrize("weights", [None, torch.linspace(1, 2, 12)])
@pytest.mark.parametrize("value", [math.nan, math.inf, 1e30])
def test_losses_and_gradients_ignore_what_is_outside_of_the_mask(
    value: float, weights: Tensor | None
) -> None:
    mask = torch.arange(12) % 3 > 0
    pred, target = torch.linspace(0, 4, 12)[None], torch.linspace(3, 0, 12)[None]
    angles = torch.linspace(1, 2, 12)

    def loss_and_gradient(outside: float) -> tuple[Tensor, Tensor]:
        values = pred.where(mask, outside).requires_grad_()
        huber = depth_index_huber(values, target.where(mask, outside), mask[None], weights=weights)
        loss = huber + solid_angle_mean(values, angles, mask).sum()
        loss.backward()
        assert values.grad is not None
        return loss.detach(), values.grad

    expected = loss_and_gradient(0.0)
    assert (expected[1][:, ~mask] == 0).all()
    torch.testing.assert_close(loss_and_gradient(value), expected, rtol=0, atol=0)


def test_an_image_counts_unless_all_of_its_errors_are_nan() -> None:
    """One error that is not a number is shown by its mean, and takes no image out of the others."""

    class Given(MeanOverImages):
        error_names = ("a", "b")

        def _errors(self, pred: Tensor, target: Tensor, **options: object) -> dict[str, Tensor]:
            return {"a": pred[:, 0], "b": pred[:, 1]}

    metric = Given()
    metric.update(torch.tensor([[math.nan, 2.0], [1.0, 4.0], [math.nan, math.nan]]), torch.ones(3, 2))
    means = metric.compute()
    assert means["a"].isnan()
    assert means["b"] == 3.0
