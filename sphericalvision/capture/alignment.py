# SPDX-License-Identifier: Apache-2.0
"""Whether a calibration is right: turns of a rig's cameras, at the depth of some frames, against their uncertainty."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.remapping.lookup import pixels_a_radian
from sphericalvision.capture.calibrating.direct_alignment import align_rig_direct
from sphericalvision.capture.calibrating.turns import about_most, turned
from sphericalvision.capture.checks import pose_agreement
from sphericalvision.capture.preparation.photometry import averaged, reduced_rig
from sphericalvision.capture.preparation.preparation import Compensator
from sphericalvision.capture.result import Depth
from sphericalvision.geometry.transforms import axis_angle_from_transform, invert_transform
from sphericalvision.icosphere import icosphere_vertices

if TYPE_CHECKING:
    from sphericalvision.capture.predictor import Predictor

LEVEL = 5
"""Icosphere level of the directions that are compared first."""
STEPS = (
    (math.radians(0.9), 1.0, 4, LEVEL),
    (math.radians(0.9), 0.6, 3, LEVEL),
    (math.radians(0.45), 0.6, 3, LEVEL + 1),
)
"""Pixel in radians, blur in pixels, iterations and level, one after the other."""
BIAS, BIAS_OF_TWO = 0.06, 0.16
"""Pixels, at least of the first step, by which turns may be wrong beyond what parts of the sphere tell: a horizon on
the rows of coarse images moves all cameras alike in every frame, and of two cameras no third one contradicts."""
USUAL_OBSERVABILITY = 0.08
"""``_observability`` of neighbours in a ring of four: turns of cameras that have less may be wrong by more."""
SURE = 2.5
"""Standard deviations beyond which a camera is turned."""
ENOUGH = math.radians(0.6)
"""A camera that may be turned by more, as far as can be told, is not called right."""
DOUBT = math.radians(0.5)
"""Where turns are known no better, the images are too coarse or too bare for a verdict."""
AGAIN, ROUNDS = math.radians(0.4), 4
"""Depth is estimated again with cameras turned, and cameras turned by that, as long as they still turn by more."""
LEAST_AGREEMENT = 0.75
"""Of images that show the same, before cameras turn: less is found where they have nothing in common."""
MOST, MOST_LEFT = math.radians(10), math.radians(1.5)
"""A camera that is found to be turned further, or still turns by the second in the last round, was not found."""
HARM = 0.01
"""By which a quick sweep may find that images agree less with cameras turned."""


class RigTurns(NamedTuple):
    """The verdict on a calibration: whether cameras are turned from what it says.

    Attributes:
        rig: with those cameras turned back that are turned for sure.
        turns: ``(n, 3)`` rotation vectors in the world, radians, as estimated of all cameras.
        spread: ``(n,)`` their standard deviations, radians.
        turned: names of the cameras that are turned; none where the calibration is right, or nothing could be told.
        agreement: 0 to 1: how well images agreed before and after.
        reason: why nothing could be told; empty if something was.
    """

    rig: CameraRig
    turns: Tensor
    spread: Tensor
    turned: tuple[str, ...] = ()
    agreement: tuple[float, float] = (0.0, 0.0)
    reason: str = ""

    @classmethod
    def undecided(cls, rig: CameraRig, reason: str) -> RigTurns:
        """Return the verdict that nothing can be told of a rig.

        Examples:
            >>> from sphericalvision.cameras import ring_rig
            >>> RigTurns.undecided(ring_rig(3), "there is no frame").described()
            'could not tell whether the calibration is right, because there is no frame'
        """
        rotations = torch.zeros(len(rig), 3, dtype=torch.float64, device=rig.world_from_camera.device)
        return cls(rig, rotations, rotations.sum(-1) + math.inf, reason=reason)

    @property
    def within(self) -> float:
        """Radians that no camera is turned by, as far as can be told."""
        return float((self.turns.norm(dim=-1) + 2 * self.spread).max())

    def described(self) -> str:
        """Return the verdict as a sentence; ± is two standard deviations, as of ``within``."""
        if self.reason:
            return f"could not tell whether the calibration is right, because {self.reason}"
        if not self.turned:
            return f"finds the calibration right: no camera is turned by more than {math.degrees(self.within):.2f}°"
        estimates = zip(self.rig.names, self.turns.norm(dim=-1).tolist(), self.spread.tolist(), strict=True)
        which = ", ".join(
            f"{name} by {math.degrees(angle):.2f}° ± {math.degrees(2 * spread):.2f}°"
            for name, angle, spread in estimates
            if name in self.turned
        )
        before, after = self.agreement
        return f"turns {which}: images agree better, {after:.3f} in place of {before:.3f} of 1"


def align_rig(predictor: Predictor, frames: Iterable[Mapping[str, Any]]) -> RigTurns:
    """Return whether cameras are turned from what the calibration says, by images at the depth estimated with it.

    Calibrations are seldom right for long: orientations wrong by a degree more than double the error of depth. They are
    found to about a tenth of a degree, from one frame or a few, in a second or two for each. Positions and intrinsics
    are not touched.

    A camera counts as turned if its turn exceeds its uncertainty clearly. Whether images agree better in a quick sweep
    does not decide, as that hardly sees small turns; but cameras stay where it says that turning them does harm.

    Args:
        predictor: of depth with the calibration; it stays as it is, ``predictor.with_changes(verdict.rig)`` uses the
            rig with the cameras turned back.
        frames: of images by camera name, as the predictor is called with, one frame each.

    Returns:
        The verdict: turns and their uncertainty, which cameras are turned, or why nothing could be told.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.scenes import make_scene, render_rig
        >>> from sphericalvision.capture import Predictor
        >>> predictor = Predictor(ring_rig(3, image_size=(64, 64)), method="semi_global", level=4, min_depth=0.55)
        >>> align_rig(predictor, [render_rig(make_scene("floating", seed=1), predictor.rig)]).turned
        ()
    """
    rig = predictor.rig
    if len(rig) < 2:
        return RigTurns.undecided(rig, "one camera has nothing to be compared with")
    images = list(frames)
    if not images:
        return RigTurns.undecided(rig, "there is no frame")

    def estimate(predictor: Predictor) -> list[Depth]:
        return [predictor(frame) for frame in images]

    depths = estimate(predictor)
    verdict = latest = _estimated(depths)
    for _ in range(ROUNDS - 1):
        if not _largest(verdict) < MOST or _largest(latest) < AGAIN:
            break
        latest = _estimated(estimate(predictor.with_changes(turned(rig, verdict.turns))))
        rotations = about_most(_between(rig, turned(latest.rig, latest.turns)))
        agreement = (verdict.agreement[0], latest.agreement[1])
        verdict = latest._replace(rig=rig, turns=rotations, agreement=agreement)
    sizes = verdict.turns.norm(dim=-1)
    sure = sizes > SURE * verdict.spread
    if len(rig) == 2:  # which of the two it was cannot be told
        sure = sure.any().expand(2)
    reason = _doubt(verdict, bool(sure.any()), _largest(latest))
    if reason or not sure.any():
        return verdict._replace(reason=reason)
    better = turned(rig, verdict.turns * sure[:, None])
    before, after = (sum(pose_agreement(depth.images, each) for depth in depths) for each in (rig, better))
    if after < before - HARM * len(depths):
        return verdict._replace(reason="a sweep finds that images agree less with the cameras turned")
    names = tuple(name for name, which in zip(rig.names, sure.tolist(), strict=True) if which)
    return verdict._replace(rig=better, turned=names)


def _doubt(verdict: RigTurns, sure: bool, latest: float) -> str:
    """Why nothing can be told; empty if something can."""
    if verdict.agreement[0] < LEAST_AGREEMENT:
        return (
            "images of different cameras show nothing in common; are they of one moment, of these cameras, and is "
            "there texture where cameras overlap?"
        )
    farthest = verdict.rig.names[int(verdict.turns.norm(dim=-1).argmax())]
    if _largest(verdict) > MOST or latest > MOST_LEFT:
        return f"{farthest} seems to be turned by more than can be found; calibrate it again"
    if verdict.spread.max() < DOUBT and (sure or verdict.within < ENOUGH):
        return ""
    doubtful = verdict.rig.names[int((verdict.turns.norm(dim=-1) + 2 * verdict.spread).argmax())]
    are_opposed = len(verdict.rig) == 2 and _observability(verdict.rig) < USUAL_OBSERVABILITY / 2
    more = "more frames, with more texture where cameras overlap, say more"
    if are_opposed:
        more = "of two cameras that look apart, turns look like depth; calibrate them with a board"
    return f"{doubtful} could be turned by up to {math.degrees(verdict.within):.2f}°; {more}"


def _largest(verdict: RigTurns) -> float:
    return float(verdict.turns.norm(dim=-1).max())


def _between(one: CameraRig, other: CameraRig) -> Tensor:
    """Rotation vectors ``(n, 3)`` in the world from the cameras of one rig to those of the other."""
    moved = other.world_from_camera.double() @ invert_transform(one.world_from_camera.double())
    return axis_angle_from_transform(moved)[0]


def _estimated(depths: Sequence[Depth]) -> RigTurns:
    """Turns from coarse to fine, and how well the coarse images agreed before and after."""
    rig = depths[0].rig
    pixel = min(step[0] for step in STEPS)
    better = reduced_rig(rig, pixel)
    compensator = Compensator(rig, partial(averaged, better))
    batches = ({name: image[None] for name, image in depth.images.items()} for depth in depths)
    frames = [compensator.smoothed(batch)[0] for batch in batches]
    images = {name: torch.cat([frame[name] for frame in frames]) for name in rig.names}
    agreements = []
    for pixel, blur, iterations, level in STEPS:
        directions = icosphere_vertices(level, torch.float32, rig.world_from_camera.device)
        inverse_depth, weights = _along(depths, directions)
        alignment = align_rig_direct(
            better, images, directions, inverse_depth, weights, pixel=pixel, blur=blur, iterations=iterations
        )
        better = alignment.rig
        agreements.append(alignment.agreement)
    coarse = max(STEPS[0][0], *(1 / pixels_a_radian(camera) for camera in rig.cameras.values()))
    bias = coarse * BIAS
    if len(rig) == 2:
        bias = coarse * BIAS_OF_TWO * max(1.0, math.sqrt(USUAL_OBSERVABILITY / _observability(rig)))
    spread = (alignment.spread.double().square() + bias**2).sqrt()
    return RigTurns(rig, about_most(_between(rig, better)), spread, agreement=agreements[0])


def _observability(rig: CameraRig) -> float:
    """How much of a turn about the worst axis can be told from depth: 1/3 where all axes are alike, 0 where nothing.

    A turn moves what a camera sees. Along the plane of both cameras and the point another depth does so as well; only
    what is across it tells the turn, and that is the axis times the base line's direction as seen along the ray. Of
    two fisheyes that look back to back all rays that both see are across the base line, so nearly all of a turn about
    an axis across it looks like depth.
    """
    directions = icosphere_vertices(LEVEL, torch.float64, rig.world_from_camera.device)
    far = rig.center + 1000 * rig.radius * directions.to(rig.center)
    rays = directions[rig.project(far).valid.all(0)]
    base = F.normalize((rig.positions[1] - rig.positions[0]).double(), dim=-1)
    across = F.normalize(base - rays * (rays @ base)[:, None], dim=-1)
    return max(float(torch.linalg.eigvalsh(across.mT @ across / max(len(rays), 1))[0]), 1e-6)


def _along(depths: Sequence[Depth], directions: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse depth of frames and how much it is to be trusted, ``(F, V)`` each."""
    network, min_depth = depths[0].network, torch.tensor([[depth.min_depth] for depth in depths])
    maps = [depth.index for depth in depths] + [depth.confidence * depth.seen for depth in depths]
    values, reached = network.index_at(torch.stack(maps), directions)
    index, trust = values.chunk(2)
    return index / ((network.num_hypotheses - 1) * min_depth.to(index)), (trust * reached).clamp(0, 1)
