# SPDX-License-Identifier: Apache-2.0
"""IcoSweepNet: features on icospheres, a sphere sweep, and regularisation of its cost volume."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from sphericalvision.core import ArgumentError, check_choice, check_counts
from sphericalvision.crown import (
    Crown,
    CrownAvgPool2d,
    CrownBatchNorm2d,
    CrownBlock3d,
    CrownConv2d,
    CrownConv3d,
    CrownConvNorm2d,
    CrownConvNorm3d,
    crown_block3d,
    crown_upsample,
    exchange,
    from_crown,
    to_crown,
)
from sphericalvision.crown.block import convolve_twice
from sphericalvision.crown.layout import crown_map
from sphericalvision.crown.recompute import RecomputedModule, recompute_if_large, recomputes
from sphericalvision.icosphere import Icosphere
from sphericalvision.icosphere.topology import check_level
from sphericalvision.kernels import Operator, is_traced
from sphericalvision.models.depth_network import DepthNetwork
from sphericalvision.models.weights.registry import register_network
from sphericalvision.sweep import (
    Aggregation,
    DepthEstimate,
    DepthHint,
    SphereSweep,
    SweepTables,
    SweepVolume,
    depth_estimate,
)
from sphericalvision.sweep.aggregation import aggregate, named_aggregation

if TYPE_CHECKING:
    from sphericalvision.cameras import CameraRig


class IcoSweepNet(DepthNetwork):
    """Depth all around from the images of any rig, projected onto icospheres.

    The weights do not depend on the level, the number of hypotheses or the rig: all may be changed after training,
    though a network is best at those of its training.

    Convention:
        As for ``DepthNetwork``; images, which ``ToSphere`` makes, are 0 outside the field of view and under masks.

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
        check_counts(feature_channels=feature_channels, volume_channels=volume_channels)
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

    def _estimate(
        self, images: Tensor, rig: CameraRig | SweepTables, seen: Tensor | None, hint: DepthHint | None
    ) -> DepthEstimate:
        # A line a stage; the largest tensors share one name, so that each is freed when the next one is there.
        features = self.extract_features(images)
        volume, views = self.sweep(features, rig, seen)
        volume = aggregate(self.aggregation, SweepVolume(volume, views))
        volume = self.regularizer.fusion(volume)
        scores = self.regularizer.refine(volume)
        return depth_estimate(scores, views)

    def tables(self, rig: CameraRig) -> SweepTables:
        """Return where each camera sees every point of the sweep, to be passed in place of the rig."""
        return self.sweep.tables(rig)

    def extract_features(self, images: Float[Tensor, "B n 3 V_image"]) -> Float[Tensor, "B n C V"]:
        """Return the features ``(B, n, C, V_{level-feature_coarsening})`` of images ``(B, n, 3, V_level)``."""
        return camera_by_camera(self.features, images)


class ResidualBlock(nn.Module):
    """Two normalised convolutions with a ReLU between them, added to the input, and a ReLU.

    With ``stride=2`` the first convolution goes to the next coarser level, and the input joins it through a 3
    x 3 mean.

    References:
        He et al. (2016), "Deep residual learning for image recognition".
    """

    def __init__(self, channels: int, stride: int = 1, norm: str = "batch") -> None:
        super().__init__()
        self.first = CrownConvNorm2d(channels, channels, stride, norm, relu=True)
        self.second = CrownConvNorm2d(channels, channels, norm=norm)
        self.shortcut = CrownAvgPool2d(stride) if stride > 1 else nn.Identity()

    def forward(self, crown: Crown) -> Crown:
        total = convolve_twice(crown, self.first, self.second) + self.shortcut(crown)
        return crown_map(torch.relu_, total)  # a sum, which nobody else has


class FeatureExtractor(RecomputedModule):
    """Map an image on the icosphere ``(B, in_channels, V_level)`` to features ``(B, channels, V_{level-coarsening})``.

    The weights do not depend on the level; the directions of each crown exchange what they know at every
    change of level.

    Args:
        channels: of the features.
        in_channels: of the images.
        norm: "batch" or "instance".
        coarsening: levels by which the features are coarser than the image: 2, as in the paper, or 1: then what
            the coarser half of the network found is added to what the finer one found, at the finer level.

    References:
        Komatsu et al. (2020), "360° depth estimation from multiple fisheye images with origami crown
        representation of icosahedron", table of layers; Lin et al. (2017), "Feature pyramid networks for
        object detection", for the sum of levels.

    Examples:
        >>> import torch
        >>> FeatureExtractor(channels=4)(torch.zeros(1, 3, 642)).shape  # level 3 to level 1
        torch.Size([1, 4, 42])
    """

    def __init__(
        self, channels: int = 32, in_channels: int = 3, norm: str = "batch", coarsening: int = 2
    ) -> None:
        super().__init__()
        check_choice("coarsening", coarsening, (1, 2))
        self.coarsening = coarsening
        self.entry = CrownConvNorm2d(in_channels, channels, 2, norm, relu=True)
        self.second = CrownConvNorm2d(channels, channels, norm=norm, relu=True)
        self.fine = nn.Sequential(*(ResidualBlock(channels, norm=norm) for _ in range(3)))
        self.coarse = nn.Sequential(
            ResidualBlock(channels, 2, norm), *(ResidualBlock(channels, norm=norm) for _ in range(4))
        )
        self.last = CrownConv2d(channels, channels)

    def forward(self, images: Float[Tensor, "B C_in V_image"]) -> Float[Tensor, "B C V"]:
        crown = exchange(convolve_twice(to_crown(images), self.entry, self.second))
        # The finest blocks hold a sixth of the memory of a training step, and are a thirtieth of its work.
        fine = exchange(self.fine(crown) if self.recompute else recompute_if_large(self.fine, crown))
        crown = exchange(self.coarse(fine))
        if self.coarsening == 1:
            crown = crown_upsample(crown) + fine
        return from_crown(self.last(crown))


def camera_by_camera(
    extractor: nn.Module, images: Float[Tensor, "B n 3 *size"]
) -> Float[Tensor, "B n C *size_of_features"]:
    """Return the features ``(B, n, C, *)`` of the images ``(B, n, 3, *)`` of n cameras.

    In training, batch normalisation takes the statistics of one camera at a time, and running statistics take one step
    a camera. Without it all cameras are one batch.

    References:
        Komatsu et al. (2020), "360° depth estimation from multiple fisheye images with origami crown
        representation of icosahedron", whose features are extracted so.

    Examples:
        >>> camera_by_camera(nn.Conv1d(3, 5, 1), torch.zeros(2, 4, 3, 42)).shape
        torch.Size([2, 4, 5, 42])
    """
    return _extract(images, extractor)


def _extract_each(images: Tensor, extractor: nn.Module) -> Tensor:
    if any(map(_takes_statistics_of_the_batch, extractor.modules())):
        return torch.stack([extractor(camera) for camera in images.unbind(1)], 1)
    return extractor(images.flatten(0, 1)).unflatten(0, images.shape[:2])  # type: ignore[no-any-return]


def _extract_in_groups(images: Tensor, extractor: nn.Module) -> Tensor:
    """All cameras in one batch, in which normalisations take statistics camera by camera.

    Not with recomputed blocks, whose groups would differ, nor for compilers, which make one graph of the loop.
    """
    norms = [part for part in extractor.modules() if _takes_statistics_of_the_batch(part)]
    grouped = [norm for norm in norms if isinstance(norm, CrownBatchNorm2d) and norm.momentum is not None]
    if not grouped or len(grouped) < len(norms) or recomputes(extractor) or is_traced():
        return NotImplemented
    number = images.shape[1]
    try:
        for norm in grouped:
            norm.groups = number
        features: Tensor = extractor(images.transpose(0, 1).flatten(0, 1))
    finally:
        for norm in grouped:
            norm.groups = 1
    return features.unflatten(0, (number, -1)).transpose(0, 1)


_extract = Operator(_extract_each, fused=_extract_in_groups)


def _takes_statistics_of_the_batch(part: nn.Module) -> bool:
    """Whether a module is a batch normalisation in training; instance normalisation has no running statistics."""
    return isinstance(part, _BatchNorm) and part.training and part.running_mean is not None


class CostRegularizer(nn.Module):
    """Map a cost volume ``(B, in_channels, N, V)`` to a score of each hypothesis ``(B, N, V)``.

    ==========  ================================  ==================================================
    name        channels                          what it does
    ==========  ================================  ==================================================
    fusion      in -> fusion -> 2 * channels      combines the cameras
    blocks      2 * channels, four times two      residual blocks
    reduction   2 * channels -> channels          first of the last pair of convolutions
    score       channels -> 1                     second of it
    ==========  ================================  ==================================================

    Every convolution but the last is normalised, with a ReLU between the two of a pair. A pair ends with the mean of
    the crown's two directions, their exchange. That mean is linear and keeps equal values, so residuals are added on
    vertices, not on crowns.

    Args:
        in_channels: of the volume.
        channels: half the width of the blocks.
        norm: "batch" or "instance".
        fusion_channels: width between the first two convolutions; ``in_channels`` when not given.

    References:
        Komatsu et al. (2020), "360° depth estimation from multiple fisheye images with origami crown
        representation of icosahedron", table of layers.

    Examples:
        >>> import torch
        >>> CostRegularizer(in_channels=8, channels=2)(torch.zeros(1, 8, 4, 42)).shape
        torch.Size([1, 4, 42])
    """

    def __init__(
        self,
        in_channels: int = 128,
        channels: int = 32,
        norm: str = "batch",
        fusion_channels: int | None = None,
    ) -> None:
        super().__init__()
        width = 2 * channels
        self.fusion = CrownBlock3d(in_channels, fusion_channels or in_channels, width, norm)
        self.blocks = nn.ModuleList(CrownBlock3d(width, width, width, norm, residual=True) for _ in range(4))
        self.reduction = CrownConvNorm3d(width, channels, norm, relu=True)
        self.score = CrownConv3d(channels, 1)

    def forward(self, volume: Float[Tensor, "B C N V"]) -> Float[Tensor, "B N V"]:
        return self.refine(self.fusion(volume))

    def refine(self, volume: Float[Tensor, "B C N V"]) -> Float[Tensor, "B N V"]:
        """Score the result of ``fusion``; a caller of both in turn can free the large volume in between."""
        for block in self.blocks:
            volume = block(volume)
        return crown_block3d(volume, self.reduction, self.score).squeeze(1)


register_network("icosweepnet", IcoSweepNet)
