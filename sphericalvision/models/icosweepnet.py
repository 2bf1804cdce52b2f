# SPDX-License-Identifier: Apache-2.0
"""IcoSweepNet: features on icospheres, a sphere sweep, and regularisation of its cost volume."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.icosphere import Icosphere, check_level, coarse_vertex_ids, num_icosphere_vertices
from sphericalvision.models.aggregation import (
    aggregated_channels,
    concatenate_cameras,
    mean_and_variance,
)
from sphericalvision.models.base import DepthNetwork
from sphericalvision.models.features import FeatureExtractor
from sphericalvision.models.recompute import recomputed
from sphericalvision.models.regularization import CostRegularizer
from sphericalvision.sweep import (
    DepthEstimate,
    SphereSweep,
    SweepTables,
    SweepVolume,
    depth_estimate,
)

if TYPE_CHECKING:
    from sphericalvision.cameras import CameraRig

__all__ = ["IcoSweepNet"]


class IcoSweepNet(DepthNetwork):
    """Depth all around from the images of any rig, projected onto icospheres.

    The weights depend neither on the level nor on the number of hypotheses or the rig: all three may be
    changed after training, though a network is best at what it was trained for.

    Convention:
        Images are in [-1, 1] and 0 outside the field of view and under masks, on icospheres aligned with the world
        (``rig.sample_sphere``), in the order of ``rig.names``. The result is a hypothesis index seen from
        ``rig.center``: 0 is infinity, N - 1 is ``min_depth``; ``depth`` turns it into metres along the ray.

    Args:
        level: of the icospheres that hold the images; the result is two levels coarser.
        num_hypotheses: N, the number of icospheres swept.
        min_depth: radius of the smallest one in metres.
        feature_channels: channels of a camera's features; all other widths are proportional.
        num_cameras: number of cameras of the rigs.
        shuffle_cameras: whether to concatenate the cameras in random order in training mode.
        norm: ``"batch"``, as in the paper, or ``"instance"``, the statistics of each sample alone: for training with
            batches of one or two.
        aggregation: ``"concatenation"`` of the cameras' features, as in the paper, or ``"variance"``: their mean
            and variance, which learns from far fewer frames and takes any number of cameras in any order.
        feature_coarsening: levels by which the features that are swept are coarser than the images: 2, as in the
            paper, or 1, which tells nearer hypotheses apart.
        volume_channels: half the width of the regulariser; ``feature_channels`` when not given.

    References:
        Komatsu, Fujii, Tamura, Yamashita and Asama (2020), "360° depth estimation from multiple fisheye
        images with origami crown representation of icosahedron"; for the variance Yao et al. (2018), "MVSNet".

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(2, radius=0.1)
        >>> net = IcoSweepNet(level=3, num_hypotheses=4, feature_channels=2, num_cameras=2).eval()
        >>> net(torch.zeros(1, 2, 3, 642), rig).shape
        torch.Size([1, 42])
    """

    def __init__(
        self,
        level: int = 7,
        num_hypotheses: int = 32,
        min_depth: float = 0.55,
        feature_channels: int = 32,
        num_cameras: int = 4,
        shuffle_cameras: bool = True,
        norm: str = "batch",
        aggregation: str = "concatenation",
        feature_coarsening: int = 2,
        volume_channels: int | None = None,
    ) -> None:
        super().__init__(num_hypotheses, min_depth, num_cameras, any_cameras=aggregation == "variance")
        if check_level(level) < 2:
            raise ArgumentError(
                f"level: expected 2 or more (the result is two levels coarser), got {level!r}"
            )
        volume_channels = feature_channels if volume_channels is None else volume_channels
        if min(feature_channels, volume_channels) < 1:
            raise ArgumentError(
                "feature_channels, volume_channels: expected positive numbers, "
                f"got {feature_channels!r} and {volume_channels!r}"
            )
        self.level = level
        self.feature_channels = feature_channels
        self.shuffle_cameras = shuffle_cameras
        self.norm = norm
        self.aggregation = aggregation
        self.feature_coarsening = feature_coarsening
        self.volume_channels = volume_channels
        self.grid = Icosphere(level - 2)
        self.features = FeatureExtractor(feature_channels, norm=norm, coarsening=feature_coarsening)
        self.sweep = SphereSweep(level - 2, num_hypotheses, min_depth, level - feature_coarsening)
        self.regularizer = CostRegularizer(
            aggregated_channels(aggregation, feature_channels, num_cameras),
            volume_channels,
            norm,
            None if aggregation == "concatenation" else 2 * volume_channels,
        )

    def tables(self, rig: CameraRig) -> SweepTables:
        """Return where each camera sees every point of the sweep, to be passed in place of the rig."""
        return self.sweep.tables(rig)

    def forward(
        self,
        images: Tensor,
        rig: CameraRig | SweepTables,
        seen: Tensor | None = None,
        *,
        camera_order: Sequence[int] | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Return the hypothesis index ``(B, V_{level-2})``, 0 to N - 1.

        Args:
            images: ``(B, n, 3, V_level)``.
            rig: of all samples or, with batched poses, a rig a sample; or the ``tables`` of either.
            seen: ``([B,] n, V_level)``, True where the images show something.
            camera_order: order in which the cameras are concatenated; when not given, that of the rig, or in
                training mode with ``shuffle_cameras`` a random one.
            generator: of the random order; the global generator of torch when not given.

        Raises:
            ShapeError: if the images have another shape than the network or the rig asks for.
        """
        return self._estimate(images, rig, seen, camera_order, generator).index

    def predict(
        self, images: Tensor, rig: CameraRig | SweepTables, seen: Tensor | None = None
    ) -> DepthEstimate:
        """Return index, confidence and whether two cameras saw it, each ``(B, V_{level-2})``; as for ``forward``."""
        return self._estimate(images, rig, seen)

    def logits(self, images: Tensor, rig: CameraRig | SweepTables, seen: Tensor | None = None) -> Tensor:
        """Return the score of every hypothesis ``(B, N, V_{level-2})``; arguments as for ``forward``."""
        return self._logits(images, rig, seen)[0]

    def _estimate(
        self,
        images: Tensor,
        rig: CameraRig | SweepTables,
        seen: Tensor | None = None,
        camera_order: Sequence[int] | None = None,
        generator: torch.Generator | None = None,
    ) -> DepthEstimate:
        return depth_estimate(*self._logits(images, rig, seen, camera_order, generator))

    def _logits(
        self,
        images: Tensor,
        rig: CameraRig | SweepTables,
        seen: Tensor | None = None,
        camera_order: Sequence[int] | None = None,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Tensor]:
        self._check_images(images)
        features = self.extract_features(images)
        tables = rig if isinstance(rig, SweepTables) else self.sweep.tables(rig)
        if tables.num_cameras != images.shape[1]:
            raise ShapeError(
                f"rig: expected {images.shape[1]} cameras, as the images have, got {tables.num_cameras}"
            )
        points_seen = self._seen(images, tables, seen)
        order = self._camera_order(images.shape[1], camera_order, generator)
        if order is not None:
            order = order.to(images.device)
            features, tables = features[:, order], tables.permuted(order)
        # In one expression, so that nothing keeps the cost volume while what follows from it is refined.
        return (
            self.regularizer.refine(self.regularizer.fuse(self._cost_volume(features, tables, points_seen))),
            points_seen,
        )

    def _cost_volume(self, features: Tensor, tables: SweepTables, seen: Tensor) -> Tensor:
        volume = self.sweep(features, tables)
        if self.aggregation == "concatenation":
            return concatenate_cameras(volume)
        return mean_and_variance(SweepVolume(volume.values, seen))

    def extract_features(self, images: Tensor) -> Tensor:
        """Return the features ``(B, n, C, V_{level-feature_coarsening})`` of images ``(B, n, 3, V_level)``.

        In training mode batch statistics are those of one camera at a time, and running statistics take one
        step a camera.
        """
        if self.training and self.norm == "batch":
            run = partial(recomputed, self.features) if self.recompute else self.features
            return torch.stack([run(camera_images) for camera_images in images.unbind(1)], 1)
        return self.features(images.flatten(0, 1)).unflatten(0, images.shape[:2])

    def _seen(self, images: Tensor, tables: SweepTables, seen: Tensor | None) -> Tensor:
        """Whether the images show something at the points of the sweep ``(B, n, N, V)``."""
        usable = ((images != 0).any(2) if seen is None else seen.expand_as(images[:, :, 0]))[:, :, None]
        for finer in range(self.level, self.level - self.feature_coarsening, -1):
            usable = usable[..., coarse_vertex_ids(finer, images.device)]
        volume = self.sweep(usable.to(images), tables)
        return volume.mask & (volume.values.squeeze(2) > 0.5)

    def _camera_order(
        self, num_cameras: int, camera_order: Sequence[int] | None, generator: torch.Generator | None
    ) -> Tensor | None:
        if camera_order is not None:
            if sorted(camera_order) != list(range(num_cameras)):
                raise ArgumentError(
                    f"camera_order: expected 0 to {num_cameras - 1} once each, got {list(camera_order)}"
                )
            return torch.as_tensor(camera_order)
        if self.training and self.shuffle_cameras and not self.any_cameras:
            device = None if generator is None else generator.device
            return torch.randperm(num_cameras, generator=generator, device=device)
        return None

    def _check_images(self, images: Tensor) -> None:
        cameras = "n" if self.any_cameras else self.num_cameras
        vertices = num_icosphere_vertices(self.level)
        fits = images.ndim == 4 and images.shape[2:] == (3, vertices)
        if not fits or (images.shape[1] != self.num_cameras and not self.any_cameras):
            raise ShapeError(
                f"images: expected shape (B, {cameras}, 3, {vertices}) for {cameras} cameras "
                f"on icospheres of level {self.level}, got {tuple(images.shape)}"
            )
