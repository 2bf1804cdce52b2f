# SPDX-License-Identifier: Apache-2.0
"""Depth of fisheyes as it is mostly made: rectified pairs, a stereo method for ordinary images, one panorama of all."""

import math
from typing import Any, ClassVar, Literal

import cv2
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, EquirectangularCamera, RectifiedPair, rectified_pairs
from sphericalvision.icosphere.topology import check_level
from sphericalvision.models import DepthNetwork
from sphericalvision.sphere import Equirectangular, Views
from sphericalvision.sphere.intake import unsigned
from sphericalvision.sweep import DepthEstimate, DepthHint, index_from_inverse_depth

BLOCK_SIZE, UNIQUENESS = 3, 5
"""Pixels of a side of the blocks that are matched; percent by which the best match is better than the second."""


class RectifiedSGBM(DepthNetwork):
    """OpenCV's semi-global matching on Cassini pairs of all cameras that share a field of view, merged around the rig.

    Where no pair says anything, the nearest direction of which one does counts, unseen and without confidence.

    Args:
        level: of the icospheres of other methods: the panorama of the result is about as fine as one a level below.
        num_hypotheses: N, of the index.
        min_depth: metres from the rig's centre; what is nearer is not looked for.

    References:
        H. Hirschmüller (2008), "Stereo processing by semiglobal matching and mutual information", as OpenCV has it.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> net = RectifiedSGBM(level=4)
        >>> net(torch.rand(1, 4, 3, 64, 64) * 2 - 1, ring_rig(4, image_size=(64, 64))).shape
        torch.Size([1, 24, 48])
    """

    images: ClassVar[Literal["sphere", "camera"]] = "camera"
    min_depth_follows: ClassVar[Literal["rig", "training", "scene"]] = "scene"
    grid: Equirectangular

    def __init__(self, level: int = 6, num_hypotheses: int = 16, min_depth: float = 0.55) -> None:
        super().__init__(num_hypotheses, min_depth, num_cameras=2, any_cameras=True)
        rows = 3 * 2 ** max(check_level(level) - 1, 0)
        self.grid = Equirectangular(rows, 2 * rows)

    def tables(self, rig: CameraRig) -> tuple[CameraRig, list[RectifiedPair]]:
        """Return the rig with its pairs, to be passed in its place."""
        return rig, rectified_pairs(rig)

    @torch.no_grad()
    def _estimate(
        self, images: Tensor, rig: CameraRig | Any, seen: Tensor | None, hint: DepthHint | None
    ) -> DepthEstimate:
        rig, pairs = self.tables(rig) if isinstance(rig, CameraRig) else rig
        usable = torch.ones_like(images[:, :, :1]) if seen is None else seen.to(images).unsqueeze(-3)
        layers = torch.cat((unsigned(images), usable.expand_as(images[:, :, :1])), -3).unbind(1)
        named = dict(zip(rig.names, layers, strict=True))
        disparities = [self._disparities(pair, rig, *pair.rectify(named)) for pair in pairs]
        height, width = self.grid.shape
        merged = Views.of_pairs(pairs, disparities, EquirectangularCamera((height, width))).merge(
            quantity="range", align=False, center=rig.center
        )
        inverse_depth = torch.where(merged.valid, 1 / merged.values.squeeze(-3).clamp(min=1e-6), 0.0)
        index = index_from_inverse_depth(inverse_depth, self.num_hypotheses, self.min_depth)
        index = index.clamp(0, self.num_hypotheses - 1)
        confidence = torch.where(merged.valid, 1 / (1 + 10 * merged.spread), 0.0)
        filled = [_filled(*frame) for frame in zip(index, merged.valid, strict=True)]
        return DepthEstimate(torch.stack(filled), confidence, merged.valid)

    def _disparities(self, pair: RectifiedPair, rig: CameraRig, left: Tensor, right: Tensor) -> Tensor:
        """Disparities of left images (B, 4, h, w), whose last channel is a mask; -1 where unknown."""
        reach = float((pair.rig.positions[0] - rig.center).norm())
        # From the left camera; never 0, where a camera stands as far out as the nearest hypothesis.
        nearest = max(self.min_depth - reach, 0.2 * self.min_depth)
        largest = float(pair.disparity(torch.full(pair.image_size, nearest))[0].max())
        levels = 16 * math.ceil((largest + 1) / 16)  # OpenCV takes multiples of 16
        area = BLOCK_SIZE**2
        matcher = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=levels,
            blockSize=BLOCK_SIZE,
            P1=8 * area,  # these two as OpenCV's examples have them
            P2=32 * area,
            disp12MaxDiff=1,
            uniquenessRatio=UNIQUENESS,
            speckleWindowSize=50,
            speckleRange=2,
            mode=cv2.STEREO_SGBM_MODE_HH,
        )
        frames = []
        for images in zip(left, right, strict=True):
            # What would be matched beyond the left edge is not estimated: a border makes room for it.
            grey = [
                cv2.copyMakeBorder(
                    (255 * image[:3].mean(0)).round().byte().numpy(), 0, 0, levels, 0, cv2.BORDER_REPLICATE
                )
                for image in images
            ]
            frames.append(torch.from_numpy(matcher.compute(*grey)[:, levels:]).float() / 16)
        disparity = torch.stack(frames)
        columns = (torch.arange(disparity.shape[-1]) - disparity).round().long()
        columns = columns.clamp(0, disparity.shape[-1] - 1)
        both_seen = left[:, 3].minimum(right[:, 3].gather(-1, columns)) > 0.99
        return disparity.where(both_seen, -1.0)


def _filled(values: Tensor, valid: Tensor) -> Tensor:
    """Values (h, w) of a panorama, the nearest valid one where they are not."""
    if not valid.any():
        return values
    width = values.shape[1]
    around = torch.cat((valid, valid, valid), 1)  # nearest across the seam, too
    from scipy.ndimage import distance_transform_edt  # half a second that other methods do not pay

    rows, columns = distance_transform_edt(~around.numpy(), return_distances=False, return_indices=True)
    center = slice(width, 2 * width)
    return values[torch.from_numpy(rows[:, center]), torch.from_numpy(columns[:, center] % width)]
