# SPDX-License-Identifier: Apache-2.0
"""Orientations of a rig's cameras from what they see: rays to the same things must meet.

Convention:
    ``turns`` are rotation vectors in the world: a camera that looks along d by the calibration looks along
    ``exp(turn) @ d`` in truth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sphericalvision.cameras.base import check_single
from sphericalvision.cameras.rig import CameraRig
from sphericalvision.capture.calibrating.turns import rightness, rotations, turned
from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.geometry.least_squares import solve_least_squares

__all__ = ["AlignedRig", "RayMatches", "align_rig"]

_FEWEST = 20
"""Matches of a camera with which its orientation is told."""
_FINEST = math.radians(0.05)
"""Misses below this are all alike: no feature is found more exactly."""
_ROUNDS = 12


class RayMatches(NamedTuple):
    """Pairs of rays of two cameras to what seems to be the same point, each in the frame of its own camera.

    Examples:
        >>> ray = torch.tensor([[0.0, 0.0, 1.0]])
        >>> one = RayMatches(torch.tensor([0]), torch.tensor([1]), ray, ray)  # straight ahead in both cameras
        >>> RayMatches.joined([one, one]).first_rays.shape
        torch.Size([2, 3])
    """

    first: Int[Tensor, " m"]
    """Index of the first camera in the rig."""
    second: Int[Tensor, " m"]
    """Index of the second camera."""
    first_rays: Float[Tensor, "m 3"]
    """Unit vectors in the frame of the first camera."""
    second_rays: Float[Tensor, "m 3"]
    """Unit vectors in the frame of the second camera."""

    @staticmethod
    def joined(parts: Sequence[RayMatches]) -> RayMatches:
        """The matches of several frames together."""
        return RayMatches(*(torch.cat(same) for same in zip(*parts, strict=True)))


class AlignedRig(NamedTuple):
    """A rig with better orientations, and how well rays meet."""

    rig: CameraRig
    turns: Float[Tensor, "n 3"]
    """By how much each camera was turned, radians."""
    spread: Float[Tensor, " n"]
    """Standard deviation of the turns, radians, as far as the misses of the inliers tell."""
    misses: Float[Tensor, " m"]
    """Angle by which each pair of rays misses now, radians."""
    inliers: Bool[Tensor, " m"]
    """Pairs that count as the same thing; False for all of a camera that has too few."""


def align_rig(rig: CameraRig, matches: RayMatches, *, expected: float = math.radians(2)) -> AlignedRig:
    """The rig with orientations for which the rays of ``matches`` intersect; positions and intrinsics do not change.

    Two rays to one point lie in a plane with the line between their cameras. The angle by which they miss it is made
    small over all pairs, robustly, with a threshold that falls from ``expected`` to what features allow: half of the
    pairs may be wrong. Turning all cameras together hardly changes these angles, so most cameras are taken to be
    right: the mean turn is zero, where cameras that turned far hardly count.

    Args:
        rig: a single rig, of which orientations are about right.
        matches: of ``RayMatcher``, or a user's own; hundreds, from several frames.
        expected: how far orientations may be off, radians.

    Raises:
        ArgumentError: a camera has too few matches, or cameras are all in one place.
        ShapeError: the parts of ``matches`` do not fit.

    References:
        Hartley, Zisserman, "Multiple view geometry in computer vision", 2nd ed. (2004), section 11.4.3 (the Sampson
        error, here for unit rays); Geman, McClure (1987) for the robust weight.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.geometry import transform_from_axis_angle
        >>> rig = ring_rig(4, radius=0.2).to(torch.float64)
        >>> points = torch.randn(200, 3, generator=torch.Generator().manual_seed(0)).double() * 3
        >>> local = (points - rig.positions[:, None]) @ rig.world_from_camera[:, :3, :3]
        >>> rays = torch.nn.functional.normalize(local, dim=-1)
        >>> knock = transform_from_axis_angle(torch.tensor([0.0, 0.01, 0.0]).double(), torch.zeros(3).double())
        >>> poses = rig.world_from_camera.clone()
        >>> poses[2] = poses[2] @ knock
        >>> pairs = torch.combinations(torch.arange(4)).repeat_interleave(200, 0)
        >>> first, second = pairs.T
        >>> which = torch.arange(200).repeat(6)
        >>> matches = RayMatches(first, second, rays[first, which], rays[second, which])
        >>> found = align_rig(CameraRig(rig.cameras, poses), matches)
        >>> bool((found.rig.world_from_camera - rig.world_from_camera).abs().max() < 1e-4)
        True
    """
    check_single(rig)
    _check(matches, len(rig))
    poses = rig.world_from_camera.detach().to("cpu", torch.float64)
    pairs = _Pairs(matches, poses)
    turns = torch.zeros(len(rig), 3, dtype=torch.float64)
    weights = torch.ones(len(rig), dtype=torch.float64)
    scale = expected
    for _ in range(_ROUNDS):
        trust = pairs.trust(turns, scale)
        turns = pairs.solve(turns, trust, weights, expected)
        weights = rightness(turns)
        scale = max(scale / 2, _FINEST, min(expected, 2 * pairs.typical_miss(turns, scale)))
    misses = pairs.misses(turns)
    inliers = (misses.abs() < 2 * scale) & pairs.in_front(turns, 2 * scale)
    _check_enough(inliers, matches, rig)
    spread = pairs.spread(turns, inliers)
    return AlignedRig(turned(rig, turns), turns.to(rig.world_from_camera), spread, misses.abs(), inliers)


class _Pairs:
    """The matches as rays in the world by the poses given, and how far they miss once cameras are turned."""

    def __init__(self, matches: RayMatches, poses: Tensor) -> None:
        self.first, self.second = matches.first.cpu().long(), matches.second.cpu().long()
        rotations, positions = poses[:, :3, :3], poses[:, :3, 3]
        rays = (matches.first_rays, matches.second_rays)
        both = [ray.detach().to("cpu", torch.float64) for ray in rays]
        self.rays = [
            (rotations[which] @ ray.unsqueeze(-1)).squeeze(-1)
            for which, ray in zip((self.first, self.second), both, strict=True)
        ]
        between = positions[self.second] - positions[self.first]
        length = between.norm(dim=-1, keepdim=True)
        self.apart = length.squeeze(-1) > 1e-6  # cameras in one place say nothing about each other here
        self.between = between / length.clamp(min=1e-6)

    def turned(self, turns: Tensor) -> tuple[Tensor, Tensor]:
        """Both rays (m, 3) in the world."""
        by_camera = rotations(turns)
        one, other = (
            (by_camera[which] @ ray.unsqueeze(-1)).squeeze(-1)
            for which, ray in zip((self.first, self.second), self.rays, strict=True)
        )
        return one, other

    def misses(self, turns: Tensor) -> Tensor:
        """Signed angles (m,), to first order: the Sampson error of the epipolar constraint."""
        one, other = self.turned(turns)
        across_one = torch.linalg.cross(self.between, one, dim=-1)
        across_other = torch.linalg.cross(self.between, other, dim=-1)
        size = across_one.square().sum(-1) + across_other.square().sum(-1)
        return (one * across_other).sum(-1) / (size + 1e-6).sqrt()

    def in_front(self, turns: Tensor, slack: float) -> Tensor:
        """Whether rays meet in front of both cameras (m,) bool: seen from the second, a point lies further back."""
        one, other = self.turned(turns)
        along_one, along_other = ((ray * self.between).sum(-1) for ray in (one, other))
        return (along_one.clamp(-1, 1).acos() <= along_other.clamp(-1, 1).acos() + slack) & self.apart

    def trust(self, turns: Tensor, scale: float) -> Tensor:
        """Weights (m,) of a robust least squares, over the scale."""
        relative = self.misses(turns) / scale
        return self.in_front(turns, 2 * scale) / (1 + relative.square()) / scale

    def typical_miss(self, turns: Tensor, scale: float) -> float:
        """Of the pairs within a scale or two: their standard deviation, by the median."""
        misses = self.misses(turns).abs()
        near = misses[(misses < 2 * scale) & self.in_front(turns, 2 * scale)]
        return float(1.4826 * near.median()) if len(near) else scale

    def solve(self, start: Tensor, trust: Tensor, weights: Tensor, expected: float) -> Tensor:
        """The turns (n, 3), about as large as expected, by which trusted pairs miss least; their weighted mean is 0."""
        hold = float(trust.square().sum().sqrt()) + 1.0

        def residuals(vector: Tensor) -> Tensor:
            turns = vector.view(-1, 3)
            mean = (weights[:, None] * turns).sum(0) / weights.sum()
            return torch.cat((self.misses(turns) * trust, hold * mean, vector / expected))

        return solve_least_squares(residuals, start.reshape(-1), iterations=10).solution.view(-1, 3)

    def spread(self, turns: Tensor, inliers: Tensor) -> Tensor:
        """Standard deviations (n,) of the turns about their mean, from the misses of the inliers."""
        columns = torch.func.jacfwd(self.misses)(turns)[inliers].flatten(1)
        misses = self.misses(turns)[inliers]
        free = torch.eye(columns.shape[1], dtype=columns.dtype)
        free = free - torch.eye(3, dtype=columns.dtype).repeat(len(turns), len(turns)) / len(turns)
        variance = (
            torch.linalg.pinv(free @ columns.mT @ columns @ free, hermitian=True) * misses.square().mean()
        )
        return variance.diagonal().view(-1, 3).sum(-1).clamp(min=0).sqrt()


def _check(matches: RayMatches, number: int) -> None:
    count = len(matches.first)
    for name in ("first_rays", "second_rays"):
        shape = tuple(getattr(matches, name).shape)
        if shape != (count, 3):
            raise ShapeError(f"matches.{name}: expected shape ({count}, 3), one a match, got {shape}")
    for name in ("first", "second"):
        places = getattr(matches, name)
        if places.shape != (count,) or (count and not 0 <= int(places.min()) <= int(places.max()) < number):
            raise ArgumentError(
                f"matches.{name}: expected ({count},) places of cameras, 0 to {number - 1}, got {places}"
            )


def _check_enough(inliers: Tensor, matches: RayMatches, rig: CameraRig) -> None:
    for place, name in enumerate(rig.names):
        of_camera = ((matches.first == place) | (matches.second == place)).cpu()
        good = int((inliers & of_camera).sum())
        if good < _FEWEST:
            raise ArgumentError(
                f"matches: camera {name} has {good} that agree, of {int(of_camera.sum())}, and {_FEWEST} are needed, "
                "better hundreds; take more frames, with texture where cameras overlap, or raise expected"
            )
