# SPDX-License-Identifier: Apache-2.0
"""Networks without parameters: sweeps, and one depth map for all images."""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import Icosphere
from sphericalvision.icosphere.topology import check_level
from sphericalvision.models.depth_network import DepthNetwork
from sphericalvision.models.weights.registry import register_network
from sphericalvision.sweep import (
    DepthEstimate,
    DepthHint,
    index_from_inverse_depth,
    photo_consistency,
    semi_global_sweep,
    semi_global_tables,
)
from sphericalvision.sweep.semi_global import SemiGlobalTables


class _WithoutTraining(DepthNetwork):
    """A network without parameters, for any number of cameras."""

    min_depth_follows: ClassVar[Literal["rig", "training", "scene"]] = "scene"

    def __init__(
        self, level: int = 6, num_hypotheses: int = 32, min_depth: float = 0.55, depth_coarsening: int = 2
    ) -> None:
        super().__init__(num_hypotheses, min_depth, num_cameras=2, any_cameras=True)
        if not 0 <= depth_coarsening <= check_level(level):
            raise ArgumentError(f"depth_coarsening: expected 0 to level = {level}, got {depth_coarsening!r}")
        self.level, self.grid = level, Icosphere(level - depth_coarsening)


class SemiGlobalSweep(_WithoutTraining):
    """``semi_global_sweep`` as a network without parameters.

    Args:
        level: of the icospheres that hold the images.
        num_hypotheses: N.
        min_depth: radius of the nearest hypothesis in metres.
        depth_coarsening: levels by which the result is coarser than the images.
        cost_coarsening: levels by which the icosphere on which cameras are compared is, at most ``depth_coarsening``.
        substeps: hypotheses tried for each of the N.
        small_penalty: of a change by one tried hypothesis between neighbours; a cost is 0 to 1.
        large_penalty: of any larger change, where colours do not change.
        contrast: change of colour that halves the large penalty, in the unit of the images.

    References:
        Hirschmüller (2008), "Stereo processing by semiglobal matching and mutual information".

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> net = SemiGlobalSweep(level=3, num_hypotheses=8)
        >>> net(torch.rand(1, 4, 3, 642), ring_rig(4)).shape
        torch.Size([1, 42])
    """

    def __init__(
        self,
        level: int = 6,
        num_hypotheses: int = 32,
        min_depth: float = 0.55,
        depth_coarsening: int = 2,
        cost_coarsening: int = 1,
        substeps: int = 2,
        small_penalty: float = 0.3,
        large_penalty: float = 3.6,
        contrast: float = 0.4,
    ) -> None:
        super().__init__(level, num_hypotheses, min_depth, depth_coarsening)
        if not 0 <= cost_coarsening <= depth_coarsening:
            raise ArgumentError(
                f"cost_coarsening: expected 0 to depth_coarsening = {depth_coarsening}, got {cost_coarsening!r}"
            )
        self.cost_level, self.substeps = level - cost_coarsening, substeps
        self.small_penalty, self.large_penalty, self.contrast = small_penalty, large_penalty, contrast

    def tables(self, rig: CameraRig) -> SemiGlobalTables:
        """Return the tables of a rig, which may be passed in its place."""
        rig = rig.to(self.device)
        return semi_global_tables(
            rig, self.num_hypotheses, self.min_depth, self.level, self.cost_level, self.substeps
        )

    @torch.no_grad()
    def _estimate(
        self, images: Tensor, rig: CameraRig | SemiGlobalTables, seen: Tensor | None, hint: DepthHint | None
    ) -> DepthEstimate:
        return semi_global_sweep(
            images,
            self.tables(rig) if isinstance(rig, CameraRig) else rig,
            self.num_hypotheses,
            self.min_depth,
            self.depth_level,
            small_penalty=self.small_penalty,
            large_penalty=self.large_penalty,
            contrast=self.contrast,
            seen=seen,
        )


class WinnerTakesAll(_WithoutTraining):
    """``photo_consistency`` as a network without parameters.

    Args:
        level: of the icospheres that hold the images.
        num_hypotheses: N.
        min_depth: radius of the nearest hypothesis in metres.
        depth_coarsening: levels by which the result is coarser than the images.

    References:
        Collins (1996), "A space-sweep approach to true multi-image matching".

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> net = WinnerTakesAll(level=3, num_hypotheses=8)
        >>> net(torch.rand(1, 4, 3, 642), ring_rig(4)).shape
        torch.Size([1, 42])
    """

    @torch.no_grad()
    def _estimate(
        self, images: Tensor, rig: CameraRig, seen: Tensor | None, hint: DepthHint | None
    ) -> DepthEstimate:
        rig = rig.to(self.device)
        return photo_consistency(images, rig, self.num_hypotheses, self.min_depth, self.depth_level, seen)


class ConstantDepth(_WithoutTraining):
    """One depth map for all images: a baseline, as a network that is no better has only learned where floors are.

    Args:
        level: of the icospheres that hold the images.
        num_hypotheses: N.
        min_depth: radius of the nearest hypothesis in metres.
        depth_coarsening: levels by which the map is coarser than the images.

    Attributes:
        index: ``(V,)`` the map; infinity until ``fit`` has seen some depths.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> net = ConstantDepth(level=3, num_hypotheses=5, min_depth=0.5).fit(torch.full((3, 42), 1.0))
        >>> net(torch.rand(1, 4, 3, 642), ring_rig(4)).round(decimals=3).unique()
        tensor([2.])
    """

    index: Tensor
    min_depth_follows = "training"

    def __init__(
        self, level: int = 6, num_hypotheses: int = 32, min_depth: float = 0.55, depth_coarsening: int = 2
    ) -> None:
        super().__init__(level, num_hypotheses, min_depth, depth_coarsening)
        self.register_buffer("index", torch.zeros(self.grid.shape))

    def fit(self, inverse_depth: Float[Tensor, "F V"], valid: Bool[Tensor, "F V"] | None = None) -> Self:
        """Set the map to the median index over frames, the one with the least mean absolute error; return the network.

        Args:
            inverse_depth: ``(F, V)`` of frames in 1/m at the vertices of the map, or ``(F, 1)`` for one depth.
            valid: ``(F, V)``, True where the depth is known; everywhere when not given.

        Raises:
            ArgumentError: no depth is known.
        """
        index = index_from_inverse_depth(inverse_depth, self.num_hypotheses, self.min_depth)
        if valid is not None:
            index = index.where(valid, math.nan)
        whole = index.nanmedian()
        if whole.isnan():
            raise ArgumentError("inverse_depth: the frames have no valid depth to take the median of")
        each = index.nanmedian(0).values
        self.index = each.where(~each.isnan(), whole).expand(self.grid.shape).to(self.index).clone()
        return self

    def _estimate(
        self, images: Tensor, rig: Any, seen: Tensor | None, hint: DepthHint | None
    ) -> DepthEstimate:
        index = self.index.expand(len(images), -1)
        return DepthEstimate(index, torch.ones_like(index), torch.ones_like(index, dtype=torch.bool))


register_network("semi-global-sweep", SemiGlobalSweep)
register_network("winner-takes-all", WinnerTakesAll)
register_network("constant-depth", ConstantDepth)
