# SPDX-License-Identifier: Apache-2.0
"""OmniMVS: features of fisheye images, a sphere sweep onto a panorama, and an encoder and decoder of its costs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.core import ArgumentError, check_choice, check_counts, short_repr
from sphericalvision.models.depth_network import DepthNetwork
from sphericalvision.models.omnimvs_parts import CostHourglass, FisheyeFeatures, Transference
from sphericalvision.models.weights.registry import register_network
from sphericalvision.sweep import (
    Aggregation,
    DepthEstimate,
    DepthHint,
    PanoramaSweep,
    SweepVolume,
    soft_argmax,
    soft_argmax_confidence,
)
from sphericalvision.sweep.aggregation import aggregate, named_aggregation
from sphericalvision.sweep.panorama_sweep import PanoramaTables

if TYPE_CHECKING:
    from sphericalvision.cameras import CameraRig
    from sphericalvision.sphere import Equirectangular

LUMINANCE = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in grey (Rec. 601)."""


class OmniMVS(DepthNetwork):
    """Depth on a panorama from the images of any rig of fisheye cameras.

    The weights do not depend on the rig, the sizes of images and panorama, or the number of hypotheses, though a
    network is best at those of its training.

    Convention:
        As for ``DepthNetwork``; images are 0 outside the field of view and under masks, and the result lies on
        ``net.grid``, a panorama aligned with the world. Pixel (2 i, 2 j) of an image, a sphere or the result is the
        centre of pixel (i, j) of a map of half the size, everywhere in the network.

    Args:
        num_hypotheses: N, an even number; every second sphere is swept, and the decoder scores all.
        min_depth: radius of the smallest sphere in metres.
        feature_channels: channels of a camera's features; all other widths are proportional.
        num_cameras: number of cameras of the rigs.
        output_size: (height, width) of the panorama: the whole sphere if the width is twice the height, else the
            latitudes near the horizon; within 45° for a width four times the height, as in the paper.
        in_channels: 1 for grey images, as in the paper (colours are turned to grey), or 3.
        norm: ``"batch"``, as in the paper, or ``"instance"``, the statistics of each sample alone: for training with
            batches of one or two.
        aggregation: ``"concatenation"`` of the cameras' features, as in the paper, or ``"variance"``: mean and
            variance over the cameras that see a point, for any number of cameras in any order. Or the name of another
            one, or an object: see ``Aggregation``.
        circular: whether convolutions on the panorama continue at the other edge; the paper pads with zeros.
        num_scales: how often the encoder halves the volume; 4 in the paper. The panorama's width is a multiple of
            ``2 ** (num_scales + 1)``, its height is even.

    Raises:
        ArgumentError: if sizes or channels are not positive or the encoder cannot halve them.

    References:
        Won, Ryu and Lim (2019), "OmniMVS: end-to-end learning for omnidirectional stereo matching"; Won, Ryu and Lim
        (2020), "End-to-end learning for omnidirectional stereo matching with uncertainty prior"; for the variance Yao
        et al. (2018), "MVSNet".

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(2, image_size=(32, 40))
        >>> net = OmniMVS(8, feature_channels=2, num_cameras=2, output_size=(8, 16), num_scales=2).eval()
        >>> net(torch.zeros(1, 2, 3, 32, 40), rig).shape
        torch.Size([1, 8, 16])
    """

    images = "camera"
    grid: Equirectangular

    def __init__(
        self,
        num_hypotheses: int = 192,
        min_depth: float = 0.55,
        feature_channels: int = 32,
        num_cameras: int = 4,
        output_size: Sequence[int] = (160, 640),
        in_channels: int = 1,
        norm: str = "batch",
        aggregation: str | Aggregation = "concatenation",
        circular: bool = False,
        num_scales: int = 4,
    ) -> None:
        super().__init__(num_hypotheses, min_depth, num_cameras)
        check_counts(feature_channels=feature_channels, num_scales=num_scales)
        check_choice("in_channels", in_channels, (1, 3))
        size = _checked_size(output_size, num_scales)
        if num_hypotheses % 2:
            raise ArgumentError(
                f"num_hypotheses: expected an even number, as every second sphere is swept, got {num_hypotheses}"
            )
        self.in_channels = in_channels
        self.image_channels = (1, 3) if in_channels == 1 else (3,)
        self.features = FisheyeFeatures(feature_channels, in_channels, norm)
        self.sweep = PanoramaSweep(size, num_hypotheses, min_depth)
        self.grid = self.sweep.grid
        self.transference = Transference(feature_channels, feature_channels, circular)
        self.aggregation = named_aggregation(aggregation, feature_channels, num_cameras)
        self.any_cameras = self.aggregation.any_cameras
        self.hourglass = CostHourglass(
            self.aggregation.out_channels,
            2 * feature_channels,
            num_scales,
            norm,
            circular,
        )

    def tables(self, rig: CameraRig) -> PanoramaTables:
        """Return the tables of a rig, which may be passed in its place."""
        return self.sweep.tables(rig)

    def _estimate(
        self, images: Tensor, rig: CameraRig | PanoramaTables, seen: Tensor | None, hint: DepthHint | None
    ) -> DepthEstimate:
        tables = self.sweep.tables_for(images, rig)
        features = self.extract_features(images)
        swept = self.sweep_features(features, tables, seen)
        volume = aggregate(self.aggregation, swept)
        scores = self.hourglass(volume).flatten(2)
        index = soft_argmax(scores).unflatten(1, self.grid.shape)
        confidence = soft_argmax_confidence(scores).unflatten(1, self.grid.shape)
        # A point is seen if two cameras see it at the nearest of the swept spheres.
        sphere = (index.detach() / self.sweep.every).round().long().clamp(max=tables.seen.shape[-3] - 1)
        views = self.sweep.seen(tables.at_spheres(sphere), seen).squeeze(-3)
        return DepthEstimate(index, confidence, views.sum(-3) >= 2)

    def extract_features(self, images: Float[Tensor, "B n C_in H W"]) -> Float[Tensor, "B n C h_f w_f"]:
        """Return the features ``(B, n, C, ceil(H / 2), ceil(W / 2))`` of images ``(B, n, 1 or 3, H, W)``.

        In training mode batch statistics are those of all cameras together.
        """
        flat = images.flatten(0, 1)
        if self.in_channels == 1 and images.shape[2] == 3:
            flat = torch.einsum("bchw,c->bhw", flat, flat.new_tensor(LUMINANCE)).unsqueeze(1)
        flat = flat.contiguous(memory_format=torch.channels_last)
        return self.features(flat).unflatten(0, images.shape[:2])  # type: ignore[no-any-return]

    def sweep_features(
        self,
        features: Float[Tensor, "B n C_in h_f w_f"],
        tables: PanoramaTables,
        seen: Bool[Tensor, "B n H W"] | Bool[Tensor, "n H W"] | None = None,
    ) -> SweepVolume:
        """Return the swept features ``(B, n, C, N/2, h/2, w/2)`` of cameras' features ``(B, n, C, h_f, w_f)``."""
        self.sweep.check_maps(features, tables)
        volumes = [
            self.transference(maps, self.sweep, tables, camera)
            for camera, maps in enumerate(features.unbind(1))
        ]
        points_seen = self.sweep.seen(tables.every_second_pixel(), seen)
        return SweepVolume(
            torch.stack(volumes, 1), points_seen.expand(len(features), *points_seen.shape[-4:])
        )


def _checked_size(output_size: Sequence[int], num_scales: int) -> tuple[int, int]:
    """Height and width, if the encoder can halve them ``num_scales`` times.

    A last row may be cut, but not a last column, or it and the first would not be neighbours.
    """
    sizes = tuple(output_size)
    whole = len(sizes) == 2 and all(isinstance(size, int) and size > 0 for size in sizes)
    # No width is a multiple of a power of two with more digits; the power of a number from a file may have no end.
    halved = whole and num_scales + 1 < sizes[1].bit_length() and sizes[1] % 2 ** (num_scales + 1) == 0
    if not halved or sizes[0] % 2:
        multiple = f"{2 ** (num_scales + 1)}" if num_scales < 32 else "2 ** (num_scales + 1)"
        raise ArgumentError(
            f"output_size: expected an even height and a width in multiples of {multiple} with "
            f"num_scales={short_repr(num_scales)}, got {list(sizes)}; choose other sizes or another num_scales"
        )
    return sizes[0], sizes[1]


register_network("omnimvs", OmniMVS)
