# SPDX-License-Identifier: Apache-2.0
"""Metrics of values on a grid of the sphere, weighted by solid angle: means and segmentation.

A pixel of an equirectangular image covers a hundredth of the area near a pole that it covers at the horizon. With
weights by solid angle the numbers of all grids, of all sizes, are the same.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Integer, Shaped
from torch import Tensor
from torchmetrics import Metric

from sphericalvision.core import ArgumentError, ShapeError, check_counts, check_type
from sphericalvision.shapes import check_shapes
from sphericalvision.sphere import SphereGrid


@check_shapes
def angular_error(
    pred: Float[Tensor, "*pred 3"], target: Float[Tensor, "*target 3"]
) -> Float[Tensor, " ..."]:
    """Return the angles in radians between directions, such as normals of a surface.

    Args:
        pred: ``(*, 3)`` of any length but zero.
        target: ``(*, 3)``, likewise.

    Returns:
        ``(*)`` from 0 to π, exact for small angles too; NaN where either is zero or not finite.

    Examples:
        >>> angular_error(torch.tensor([2.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0]))
        tensor(1.5708)
    """
    pred, target = (vectors / vectors.abs().amax(-1, keepdim=True) for vectors in (pred, target))
    cross = torch.linalg.cross(*torch.broadcast_tensors(pred, target))
    return torch.atan2(cross.norm(dim=-1), (pred * target).sum(-1))


class _OnGrid(Metric):
    """A metric of values on one grid, whose solid angles it owns."""

    full_state_update = False
    solid_angles: Tensor

    def __init__(self, grid: SphereGrid, **kwargs: object) -> None:
        check_type("grid", grid, SphereGrid, "values are weighted by its solid angles")
        super().__init__(**kwargs)
        self.grid_shape = tuple(grid.shape)
        self.register_buffer("solid_angles", grid.solid_angles.double().flatten(), persistent=False)

    def _flat(self, name: str, values: Tensor) -> Tensor:
        """Return ``(B, *grid.shape)`` as ``(B, n)``."""
        if tuple(values.shape[1:]) != self.grid_shape:
            size = ", ".join(map(str, self.grid_shape))
            raise ShapeError(f"{name}: expected shape (B, {size}) on this grid, got {tuple(values.shape)}")
        return values.flatten(1)

    def _weights(self, values: Tensor, mask: Tensor | None) -> Tensor:
        """Return the solid angles ``(B, n)`` of values, zero outside the mask."""
        weights = self.solid_angles.expand(values.shape)
        return weights if mask is None else weights * mask.flatten(1).bool()


class SolidAngleMean(_OnGrid):
    """Mean of values over the sphere, per image and then over images with a valid point.

    The values are any error at each point: ``(pred - target).abs()``, ``angular_error(...)``.

    Args:
        grid: on which the values lie.

    ``update`` takes values ``(B, *grid.shape)`` and an optional mask of that shape, True where they count; values
    outside have no influence, NaN included. ``compute`` returns a scalar: NaN if there was no image, or if a value that
    counts is NaN.

    Raises:
        ShapeError: if values or mask do not lie on the grid.

    Examples:
        >>> from sphericalvision.sphere import Equirectangular
        >>> grid = Equirectangular(64, 128)
        >>> metric = SolidAngleMean(grid)
        >>> metric.update(grid.directions[None, ..., 1].square())  # y² has the mean 1/3 over the sphere
        >>> metric.compute()
        tensor(0.3334)
    """

    total: Tensor
    num_images: Tensor

    def __init__(self, grid: SphereGrid, **kwargs: object) -> None:
        super().__init__(grid, **kwargs)
        for name in ("total", "num_images"):
            self.add_state(name, default=torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    @check_shapes
    def update(
        self, values: Shaped[Tensor, " B *grid"], mask: Shaped[Tensor, " B *grid"] | None = None
    ) -> None:
        """Add a batch."""
        flat = self._flat("values", values)
        weights = self._weights(flat, mask)
        means = torch.where(weights > 0, flat * weights, 0.0).sum(1) / weights.sum(1)
        counts = weights.sum(1) > 0
        self.total += means[counts].sum()
        self.num_images += counts.sum()

    def compute(self) -> Float[Tensor, ""]:
        """Return the mean."""
        return (self.total / self.num_images).float()


class SolidAngleIoU(_OnGrid):
    """Segmentation on the sphere: accuracy and intersection over union, by solid angle instead of by pixels.

    Areas of all images are pooled before they are divided, as is usual for intersection over union.

    Args:
        grid: on which labels lie.
        num_classes: number of classes; labels are 0 to num_classes - 1.
        ignore_index: true label of points that do not count.

    ``update`` takes predicted and true labels ``(B, *grid.shape)`` and an optional mask. ``compute`` returns
    ``"accuracy"``, ``"mIoU"`` (mean over classes that occur in prediction or truth) and ``"IoU"`` ``(num_classes,)``,
    NaN for classes that do not occur.

    Raises:
        ShapeError: if labels or mask do not lie on the grid.
        ArgumentError: if labels are no integers, or one that counts is none of the classes.

    Examples:
        >>> from sphericalvision.icosphere import Icosphere
        >>> ico = Icosphere(2)
        >>> upper = (ico.vertices[None, :, 1] < 0).long()
        >>> metric = SolidAngleIoU(ico, num_classes=2)
        >>> metric.update(upper, upper)
        >>> metric.compute()["mIoU"]
        tensor(1.)
    """

    areas: Tensor

    def __init__(
        self, grid: SphereGrid, num_classes: int, ignore_index: int | None = None, **kwargs: object
    ) -> None:
        super().__init__(grid, **kwargs)
        check_counts(num_classes=num_classes)
        self.num_classes, self.ignore_index = num_classes, ignore_index
        zeros = torch.zeros(num_classes, num_classes, dtype=torch.float64)
        self.add_state("areas", default=zeros, dist_reduce_fx="sum")

    @check_shapes
    def update(
        self,
        pred: Integer[Tensor, " B *grid"],
        target: Integer[Tensor, " B *grid"],
        mask: Shaped[Tensor, " B *grid"] | None = None,
    ) -> None:
        """Add a batch of labels."""
        # Bytes would wrap around below.
        predicted, true = self._flat("pred", pred).long(), self._flat("target", target).long()
        weights = self._weights(true, mask)
        if self.ignore_index is not None:
            weights = weights * (true != self.ignore_index)
        counts = weights > 0
        for name, labels in (("pred", predicted[counts]), ("target", true[counts])):
            if len(labels) and not 0 <= int(labels.min()) <= int(labels.max()) < self.num_classes:
                raise ArgumentError(
                    f"{name}: expected labels from 0 to {self.num_classes - 1}, got {int(labels.min())} to "
                    f"{int(labels.max())}; leave others out by a mask or ignore_index"
                )
        pair = true[counts] * self.num_classes + predicted[counts]
        self.areas.view(-1).index_add_(0, pair, weights[counts])

    def compute(self) -> dict[str, Float[Tensor, " ..."]]:
        """Return accuracy and intersection over union."""
        intersection = self.areas.diagonal()
        iou = intersection / (self.areas.sum(0) + self.areas.sum(1) - intersection)
        accuracy = intersection.sum() / self.areas.sum()
        return {"accuracy": accuracy.float(), "mIoU": iou.nanmean().float(), "IoU": iou.float()}
