# SPDX-License-Identifier: Apache-2.0
"""Errors of images as metrics of torchmetrics: means over images, summed over batches and processes."""

from __future__ import annotations

from abc import abstractmethod

import torch
from jaxtyping import Float, Shaped
from torch import Tensor
from torchmetrics import Metric

from sphericalvision.core import ArgumentError, check_counts
from sphericalvision.metrics.depth_errors import depth_error, depth_index_error
from sphericalvision.metrics.omnimvs import omnimvs_error
from sphericalvision.metrics.stereo import left_right_error, stereo_error


class MeanOverImages(Metric):
    """Means over images of errors known for each image; states are sums, so processes add up."""

    full_state_update = False
    error_names: tuple[str, ...]
    takes_weights = True
    sums: Tensor
    num_images: Tensor

    def __init__(self, **kwargs: object) -> None:
        super().__init__(**kwargs)
        zeros = torch.zeros(len(self.error_names), dtype=torch.float64)
        self.add_state("sums", default=zeros, dist_reduce_fx="sum")
        self.add_state("num_images", default=torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    @abstractmethod
    def _errors(self, pred: Tensor, target: Tensor, **options: Tensor | None) -> dict[str, Tensor]:
        """Return the errors of each image ``(B,)`` by name; NaN for an image that does not count."""

    def update(
        self,
        pred: Float[Tensor, " B *grid"],
        target: Float[Tensor, " B *grid"],
        mask: Shaped[Tensor, " B *grid"] | None = None,
        weights: Float[Tensor, "*grid"] | Float[Tensor, " B *grid"] | None = None,
    ) -> None:
        """Add a batch: ``(B, V)`` predictions and truth, an optional ``(B, V)`` mask and ``(V,)`` weights."""
        options = {"mask": mask}
        if weights is not None:
            if not self.takes_weights:
                raise ArgumentError(
                    f"weights: {type(self).__name__} has none; all that counts counts the same"
                )
            options["weights"] = weights
        errors = self._errors(pred, target, **options)
        table = torch.stack([errors[name] for name in self.error_names])
        counts = ~table.isnan().all(0)
        self.sums += table[:, counts].sum(1)
        self.num_images += counts.sum()

    def compute(self) -> dict[str, Float[Tensor, ""]]:
        """Return the means over all images with at least one valid point, by name; NaN if there was none."""
        means = (self.sums / self.num_images).float()
        return dict(zip(self.error_names, means, strict=True))


class DepthIndexError(MeanOverImages):
    """The errors that papers report: ``>1 >3 >5 MAE RMS`` in percent of N, averaged over images.

    See ``depth_index_error``; images without a valid point do not count.

    Args:
        num_hypotheses: N, the number of hypotheses that the indices refer to.

    Examples:
        >>> metric = DepthIndexError(num_hypotheses=100)
        >>> metric.update(torch.tensor([[0.0, 4.0]]), torch.tensor([[0.0, 0.0]]))
        >>> metric.update(torch.tensor([[9.0, 9.0]]), torch.tensor([[9.0, 0.0]]), mask=torch.tensor([[True,
        ...     False]]))
        >>> {name: value.item() for name, value in metric.compute().items()}["MAE"]
        1.0
    """

    error_names = (">1", ">3", ">5", "MAE", "RMS")

    def __init__(self, num_hypotheses: int, **kwargs: object) -> None:
        super().__init__(**kwargs)
        check_counts(num_hypotheses=num_hypotheses)
        self.num_hypotheses = num_hypotheses

    def _errors(self, pred: Tensor, target: Tensor, **options: Tensor | None) -> dict[str, Tensor]:
        return depth_index_error(pred, target, self.num_hypotheses, **options)


class DepthError(MeanOverImages):
    """``AbsRel``, ``RMSE`` (m) and ``d<1.25`` of depths in metres, per image and then averaged over images.

    See ``depth_error``; images without a valid point do not count.

    Args:
        max_depth: in metres; predictions are cut there, and true depths beyond are left out.

    Examples:
        >>> metric = DepthError()
        >>> metric.update(torch.tensor([[2.0, 1.1]]), torch.tensor([[1.0, 1.0]]))
        >>> {name: round(value.item(), 2) for name, value in metric.compute().items()}
        {'AbsRel': 0.55, 'RMSE': 0.71, 'd<1.25': 0.5}
    """

    error_names = ("AbsRel", "RMSE", "d<1.25")

    def __init__(self, max_depth: float = 100.0, **kwargs: object) -> None:
        super().__init__(**kwargs)
        if not max_depth > 0:
            raise ArgumentError(f"max_depth: expected a positive number of metres, got {max_depth!r}")
        self.max_depth = max_depth

    def _errors(self, pred: Tensor, target: Tensor, **options: Tensor | None) -> dict[str, Tensor]:
        return depth_error(pred, target, max_depth=self.max_depth, **options)


class OmniMVSError(MeanOverImages):
    """``omnimvs_error`` as a metric: per image and then averaged over images.

    ``update`` takes inverse depths ``(B, h, w)``, predicted and true, and an optional mask.

    Args:
        min_depth: nearest hypothesis in metres.

    Raises:
        ArgumentError: if it is not positive.

    Examples:
        >>> import torch
        >>> metric = OmniMVSError(min_depth=0.5)
        >>> metric.update(torch.full((2, 4, 8), 1.05), torch.ones(2, 4, 8))
        >>> {name: round(value.item(), 2) for name, value in metric.compute().items()}
        {'>1': 100.0, '>3': 0.0, '>5': 0.0, 'MAE': 2.49, 'RMS': 2.49}
    """

    error_names = DepthIndexError.error_names
    takes_weights = False

    def __init__(self, min_depth: float = 0.55, **kwargs: object) -> None:
        super().__init__(**kwargs)
        if not min_depth > 0:
            raise ArgumentError(f"min_depth: expected a positive number of metres, got {min_depth!r}")
        self.min_depth = min_depth

    def _errors(self, pred: Tensor, target: Tensor, **options: Tensor | None) -> dict[str, Tensor]:
        return omnimvs_error(pred, target, self.min_depth, **options)


class StereoError(MeanOverImages):
    """``MAE``, ``RMSE`` and ``MARE`` of depth or disparity, per image and then averaged over images.

    See ``stereo_error``; images without a valid point do not count.

    Examples:
        >>> import torch
        >>> metric = StereoError()
        >>> metric.update(torch.tensor([[2.0, 3.0]]), torch.tensor([[1.0, 3.0]]))
        >>> metric.compute()["MAE"]
        tensor(0.5000)
    """

    error_names = ("MAE", "RMSE", "MARE")

    def _errors(self, pred: Tensor, target: Tensor, **options: Tensor | None) -> dict[str, Tensor]:
        flat = {
            name: None if values is None else values.flatten(1 if values.shape == pred.shape else 0)
            for name, values in options.items()
        }
        return stereo_error(pred.flatten(1), target.flatten(1), **flat)


class LeftRightError(MeanOverImages):
    """``LRCE`` of panoramas ``(B, h, w)``, per image and then averaged over images; see ``left_right_error``.

    Examples:
        >>> import torch
        >>> metric = LeftRightError()
        >>> metric.update(torch.tensor([[[1.0, 3.0]]]), torch.tensor([[[1.0, 2.0]]]))
        >>> metric.compute()["LRCE"]
        tensor(1.)
    """

    error_names = ("LRCE",)
    takes_weights = False

    def _errors(self, pred: Tensor, target: Tensor, **options: Tensor | None) -> dict[str, Tensor]:
        return left_right_error(pred, target, **options)
