# SPDX-License-Identifier: Apache-2.0
"""IcoSweepNet: features on icospheres, a sphere sweep, and regularisation of its cost volume."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import Icosphere
from sphericalvision.icosphere.topology import check_level
from sphericalvision.models.base import DepthNetwork
from sphericalvision.models.features import FeatureExtractor, camera_by_camera
from sphericalvision.models.regularization import CostRegularizer
from sphericalvision.models.weights.registry import register_network
from sphericalvision.sweep import (
    Aggregation,
    DepthEstimate,
    SphereSweep,
    SweepTables,
    SweepVolume,
    depth_estimate,
)
from sphericalvision.sweep.aggregation import named_aggregation

if TYPE_CHECKING:
    from sphericalvision.cameras import CameraRig

__all__ = ["IcoSweepNet"]


class IcoSweepNet(DepthNetwork):
    """Depth all around from the images of any rig, projected onto icospheres.

    The weights depend neither on the level nor on the number of hypotheses or the rig: all three may be
    changed after training, though a network is best at what it was trained for.

    Convention:
        Images are in [-1, 1] and 0 outside the field of view and under masks, on icospheres aligned with the world
        (``ToSphere``), in the order of ``rig.names``. The result is a hypothesis index seen from
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
            and variance, which learns from far fewer frames and takes any number of cameras in any order. Or the name
            of another one, or an object: see ``Aggregation``.
        feature_coarsening: levels by which the features that are swept are coarser than the images: 2, as in the
            paper, or 1, which tells nearer hypotheses apart.
        volume_channels: half the width of the regulariser; ``feature_channels`` when not given.

    References:
        Komatsu, Fujii, Tamura, Yamashita and Asama (2020), "360° depth estimation from multiple fisheye
        images with origami crown representation of icosahedron"; for the variance Yao et al. (2018), "MVSNet".

    Examples:
        >>> import torch
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
        aggregation: str | Aggregation = "concatenation",
        feature_coarsening: int = 2,
        volume_channels: int | None = None,
    ) -> None:
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
        super().__init__(num_hypotheses, min_depth, num_cameras)
        self.level, self.grid = level, Icosphere(level - 2)
        self.features = FeatureExtractor(feature_channels, norm=norm, coarsening=feature_coarsening)
        self.sweep = SphereSweep(level - 2, num_hypotheses, min_depth, level - feature_coarsening)
        self.aggregation = named_aggregation(aggregation, feature_channels, num_cameras, shuffle_cameras)
        self.any_cameras = self.aggregation.any_cameras
        # The paper keeps the width of its concatenation up to the second convolution.
        fusion_channels = 2 * volume_channels if self.any_cameras else self.aggregation.out_channels
        self.regularizer = CostRegularizer(
            self.aggregation.out_channels, volume_channels, norm, fusion_channels
        )

    def predict(
        self,
        images: Float[Tensor, "B n 3 V_image"],
        rig: CameraRig | SweepTables,
        seen: Bool[Tensor, "B n V_image"] | Bool[Tensor, "n V_image"] | None = None,
    ) -> DepthEstimate:
        """Return index, confidence and whether two cameras saw it, each ``(B, V_{level-2})``.

        Args:
            images: ``(B, n, 3, V_level)``.
            rig: of all samples or, with batched poses, a rig a sample; or the ``tables`` of either.
            seen: ``([B,] n, V_level)``, True where the images show something. When not given, all that is inside the
                fields of view was seen.

        Raises:
            ShapeError: if the images have another shape than the network or the rig asks for.
        """
        self.check_images(images, seen)
        # A line a stage; the largest tensors share one name, so that each goes as soon as the next one stands.
        features = self.extract_features(images)
        volume, views = self.sweep(features, rig, seen)
        volume = self.aggregation(SweepVolume(volume, views))
        volume = self.regularizer.fusion(volume)
        scores = self.regularizer.refine(volume)
        return depth_estimate(scores, views)

    def tables(self, rig: CameraRig) -> SweepTables:
        """Return where each camera sees every point of the sweep, to be passed in place of the rig."""
        return self.sweep.tables(rig)

    def extract_features(self, images: Float[Tensor, "B n 3 V_image"]) -> Float[Tensor, "B n C V"]:
        """Return the features ``(B, n, C, V_{level-feature_coarsening})`` of images ``(B, n, 3, V_level)``."""
        return camera_by_camera(self.features, images)


register_network("icosweepnet", IcoSweepNet)
