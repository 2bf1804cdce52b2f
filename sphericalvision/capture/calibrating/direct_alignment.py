# SPDX-License-Identifier: Apache-2.0
"""Orientations of a rig's cameras from brightness alone: images must agree where depth is about known.

All directions of one frame are compared: no features have to be found and matched. What is compared are images without
shading: a band of spatial frequencies, over its local contrast. Neither exposure nor vignetting remain, which would
pull cameras towards each other's shade.

Convention:
    ``turns`` are rotation vectors in the world: a camera that looks along d by the calibration looks along
    ``exp(turn) @ d`` in truth.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.base import Camera, check_single
from sphericalvision.cameras.remapping.lookup import pixels_a_radian
from sphericalvision.cameras.rig import CameraRig, check_images_of
from sphericalvision.capture.calibrating.turns import rightness, rotations, turned
from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.icosphere import icosphere_vertices
from sphericalvision.shapes import check_shapes

_BAND = 4.0
"""How much wider the mean is that is taken away, and the contrast that is divided by, than the blur."""
_CONTRAST = 0.02
"""Of the range [0, 1]: weaker texture is noise, and is not raised to the contrast of the rest."""
_NEAREST = 0.9
"""Of the rig's radius over depth: nothing is sought within the rig."""
_STIFFNESS = 20.0
"""An expected turn counts as many directions that disagree as they typically do: neighbours are not independent."""
_HOLD = 0.05
"""Of the mean curvature in depth: holds depth to what it was said to be, where there is no texture."""
_PARTS = 42
"""Of the sphere, each nearest to a vertex of the icosphere of level 1, that contradict each other by chance."""


class DirectAlignment(NamedTuple):
    """A rig with better orientations, and how well images agree."""

    rig: CameraRig
    turns: Float[Tensor, "n 3"]
    """By how much each camera was turned, radians."""
    spread: Float[Tensor, " n"]
    """Standard deviation of the turns, radians, as far as parts of the sphere contradict each other."""
    agreement: tuple[float, float]
    """0 to 1, of all pairs of cameras in all directions, before and after."""


@check_shapes
def align_rig_direct(
    rig: CameraRig,
    images: Mapping[str, Float[Tensor, "*frames c _ _"]],
    directions: Float[Tensor, "V 3"],
    inverse_depth: Float[Tensor, "*frames V"],
    weights: Float[Tensor, "*frames V"] | None = None,
    *,
    pixel: float = math.radians(0.9),
    blur: float = 1.0,
    iterations: int = 5,
    expected: float = math.radians(0.5),
) -> DirectAlignment:
    """The rig with orientations for which images agree; positions and intrinsics do not change.

    Gauss-Newton steps on the orientations of all cameras and the depth of all directions at once, of which depth is
    eliminated (Schur complement); robust against what is hidden, and held by ``expected``. Each direction has a depth
    of its own, without regard to its neighbours, which serves the turns and is not worth keeping. Turning all cameras
    together changes nothing but where the world's axes point, so most cameras are taken to be right: the mean turn is
    zero, where cameras that turned far hardly count.

    Orientations may be off by a pixel or two of those compared. For better ones call it again with the rig that it
    found, and a smaller ``blur`` or ``pixel``.

    Args:
        rig: a single rig, of which orientations are about right.
        images: camera name -> ``([F,] c, h, w)`` in [0, 1], of one frame or several.
        directions: unit vectors in the world, such as an icosphere's vertices.
        inverse_depth: 1/m from the rig's centre, as a network estimates it with the rig as it is.
        weights: how much directions count, such as the confidence of depth; all alike when not given.
        pixel: radians; images that are finer are averaged to this.
        blur: standard deviation in pixels, of what is left of the image at least.
        iterations: Gauss-Newton steps.
        expected: how far orientations may be off, radians.

    Raises:
        ArgumentError: images of other cameras, one camera alone, all cameras in one place, or a number that is not
            above 0.
        ShapeError: depth, weights or images do not fit each other.

    References:
        Engel, Koltun, Cremers (2018), "Direct sparse odometry", of which this is the windowed optimisation with dense
        points and known positions; Triggs et al. (2000), "Bundle adjustment: a modern synthesis", section 6.1;
        Geman, McClure (1987) for the robust weight.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.geometry import transform_from_axis_angle
        >>> from sphericalvision.scenes import make_scene, ray_depth, render_rig
        >>> from sphericalvision.icosphere import icosphere_vertices
        >>> rig, scene = ring_rig(4, image_size=(128, 128)), make_scene("floating", seed=2)
        >>> directions = icosphere_vertices(5)
        >>> inverse_depth = ray_depth(scene, rig.center, directions).reciprocal()
        >>> poses = rig.world_from_camera.clone()
        >>> poses[2] = poses[2] @ transform_from_axis_angle(torch.tensor([0.0, 0.01, 0.0]), torch.zeros(3))
        >>> wrong = CameraRig(rig.cameras, poses)
        >>> found = align_rig_direct(wrong, render_rig(scene, rig), directions, inverse_depth)
        >>> bool(0.007 < found.turns[2].norm() < 0.013)  # radians; it was 0.01
        True
        >>> found.agreement[1] > found.agreement[0]
        True
    """
    check_single(rig)
    for name, value in (("pixel", pixel), ("blur", blur), ("iterations", iterations), ("expected", expected)):
        if not value > 0:
            raise ArgumentError(f"{name}: expected more than 0, got {value!r}")
    if len(rig) < 2:
        raise ArgumentError("rig: expected two or more cameras that see the same things, got one")
    check_images_of(rig, images)
    frames = inverse_depth.shape[:-1]
    for name, image in images.items():
        if image.shape[:-3] != frames:
            shape = ", ".join(map(str, (*frames, "c", *image.shape[-2:])))
            raise ShapeError(f"images[{name!r}]: expected shape ({shape}), got {tuple(image.shape)}")
    device = rig.world_from_camera.device
    directions = directions.to(device, torch.float32)
    count = math.prod(frames)
    depth = inverse_depth.detach().to(device, torch.float32).reshape(count, -1)
    trust = torch.ones_like(depth) if weights is None else weights.detach().to(device, torch.float32)
    views = []
    for name, camera in rig.cameras.items():
        image = images[name].to(device, torch.float32).reshape(count, *images[name].shape[-3:])
        views.append(_View(camera, image, rig.masks.get(name), pixel, blur))
    with torch.no_grad():
        problem = _Problem(rig, views, directions, trust.reshape(count, -1), expected)
        turns, spread, agreement = problem.solve(depth * problem.radius, iterations)
    like = rig.world_from_camera
    return DirectAlignment(turned(rig, turns), turns.to(like), spread.to(like), agreement)


class _Samples(NamedTuple):
    """What a camera shows in directions of the world."""

    values: Tensor
    """``(F, c, V)``"""
    valid: Tensor
    """``(F, V)``"""
    by_turn: Tensor
    """``(3, F, c, V)`` by its rotation vector in the world."""
    by_depth: Tensor
    """``(F, c, V)`` by the parallax, radius over depth."""


class _View:
    """One camera's images ready to be compared: coarse, without shading, over their contrast."""

    def __init__(
        self, camera: Camera, images: Tensor, mask: Tensor | None, pixel: float, blur: float
    ) -> None:
        from kornia.filters import gaussian_blur2d  # a second to import

        self.camera = camera
        fine = pixels_a_radian(camera)
        self.shrink = max(1, int(pixel * fine))
        self.pixel = self.shrink / fine
        usable = camera.unproject(camera.pixel_grid()).valid
        if mask is not None:
            usable = usable & mask
        covered = usable.to(images)[None, None]
        images, self.shown = images * covered, covered
        if self.shrink > 1:
            images, self.shown = (F.avg_pool2d(x, self.shrink, ceil_mode=True) for x in (images, covered))

        def mean(values: Tensor, sigma: float) -> Tensor:
            size = (2 * math.ceil(3 * sigma) + 1,) * 2
            total, weight = (gaussian_blur2d(x, size, (sigma,) * 2, "constant") for x in (values, self.shown))
            return total / weight.clamp(min=1e-3)

        # the images are already multiplied with what is shown, so both means leave out the rest
        band = (mean(images, blur) - mean(images, _BAND * blur)) * self.shown
        contrast = mean(band.square().sum(1, keepdim=True), _BAND * blur)
        self.images = band / (contrast + _CONTRAST**2).sqrt()

    def look(self, rays: Tensor) -> tuple[Tensor, Tensor]:
        """Values ``(F, c, k, V)`` of rays ``(F, k, V, 3)`` in the camera's frame, validity ``(F, V)`` of the first."""
        pixels, valid = self.camera.project(rays)
        height, width = self.images.shape[-2:]
        size = pixels.new_tensor([width, height])
        grid = (pixels + 0.5) / self.shrink * 2 / size - 1
        values = F.grid_sample(self.images, grid, align_corners=False)
        covered = F.grid_sample(self.shown.expand(len(rays), -1, -1, -1), grid[:, :1], align_corners=False)
        return values, valid[:, 0] & (covered[:, 0, 0] > 0.99)


class _Problem:
    """The least-squares problem of a rig: turns of cameras (n, 3) and parallaxes of directions (F, V)."""

    def __init__(
        self, rig: CameraRig, views: list[_View], directions: Tensor, trust: Tensor, expected: float
    ) -> None:
        poses = rig.world_from_camera.double()
        offsets = rig.center.double() - poses[:, :3, 3]
        self.radius = float(offsets.norm(dim=-1).mean())
        if self.radius < 1e-6:
            raise ArgumentError(
                "rig: all its cameras are in one place, so that there is no depth to agree on"
            )
        self.offsets = (offsets / self.radius).to(directions)
        self.rotations = poses[:, :3, :3]
        self.views, self.directions, self.trust, self.expected = views, directions, trust, expected
        self.parts = (directions @ icosphere_vertices(1, torch.float32, directions.device).mT).argmax(-1)

    def solve(self, parallax: Tensor, iterations: int) -> tuple[Tensor, Tensor, tuple[float, float]]:
        """Turns, their standard deviations, and how well images agreed before and after."""
        rotations = torch.zeros(len(self.views), 3, dtype=torch.float64, device=parallax.device)
        start = parallax = parallax.clamp(0, _NEAREST)
        agreements = []
        for iteration in range(iterations + 1):
            samples = [self._samples(place, rotations, parallax) for place in range(len(self.views))]
            step, deeper, spread, agreement = self._step(samples, rotations, parallax - start)
            agreements.append(agreement)
            if iteration < iterations:
                rotations, parallax = rotations + step, (parallax + deeper).clamp(0, _NEAREST)
        return rotations, spread, (agreements[0], agreements[-1])

    def _samples(self, place: int, turns: Tensor, parallax: Tensor) -> _Samples:
        view, offset = self.views[place], self.offsets[place]
        rays = self.directions + parallax.unsqueeze(-1) * offset
        length = rays.norm(dim=-1, keepdim=True)
        rays = rays / length
        world_from_camera = (rotations(turns)[place] @ self.rotations[place]).to(rays)
        small = 0.3 * view.pixel
        tangents = _tangents(rays)
        moved = small * torch.stack((tangents, -tangents), 2).flatten(1, 2)  # (F, 4, V, 3)
        local = torch.cat((rays.unsqueeze(1), rays.unsqueeze(1) + moved), 1) @ world_from_camera
        values, valid = view.look(local)
        slopes = (values[:, :, 1::2] - values[:, :, 2::2]) / (2 * small)  # (F, c, 2, V)
        across = torch.linalg.cross(tangents, rays.unsqueeze(1), dim=-1)  # what a turn moves: turn @ across
        by_turn = (slopes * across.movedim(-1, 0).unsqueeze(2)).sum(3)
        by_depth = (slopes * (tangents @ offset / length.mT).unsqueeze(1)).sum(2)
        return _Samples(values[:, :, 0], valid, by_turn, by_depth)

    def _step(
        self, samples: list[_Samples], turns: Tensor, moved: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, float]:
        """Changes of turns and parallaxes, the standard deviation of each camera's turn, and how well images agree."""
        size = 3 * len(samples)
        curve = turns.new_zeros(size, size)
        slopes, mixed = (self.trust.new_zeros(size, *self.trust.shape) for _ in range(2))
        depth_curve, depth_slope = torch.zeros_like(self.trust), torch.zeros_like(self.trust)
        typical, agreed, compared = [], 0.0, 1e-9
        for one, other in combinations(range(len(samples)), 2):
            difference = samples[one].values - samples[other].values
            square = difference.square().sum(1)
            overlap = self.trust * (samples[one].valid & samples[other].valid)
            agreed += float((overlap / (1 + square)).sum())
            compared += float(overlap.sum())
            weight = overlap / (1 + square).square()
            columns = torch.cat((samples[one].by_turn, -samples[other].by_turn))  # (6, F, c, V)
            weighted = columns * weight.unsqueeze(1)
            parameters = torch.tensor([3 * camera + axis for camera in (one, other) for axis in range(3)])
            parameters = parameters.to(curve.device)
            curve[parameters[:, None], parameters] += (weighted.flatten(1) @ columns.flatten(1).mT).double()
            slopes[parameters] += (weighted * difference).sum(2)
            by_depth = samples[one].by_depth - samples[other].by_depth
            mixed[parameters] += (weighted * by_depth).sum(2)
            depth_curve += (by_depth.square().sum(1)) * weight
            depth_slope += (by_depth * difference).sum(1) * weight
            typical.append(square[overlap > 0])
        hold = _HOLD * depth_curve.mean() + 1e-9
        depth_curve, depth_slope = depth_curve + hold, depth_slope + hold * moved
        curve -= ((mixed / depth_curve).flatten(1) @ mixed.flatten(1).mT).double()
        slopes -= mixed * (depth_slope / depth_curve)
        sums = slopes.new_zeros(size, _PARTS).index_add(1, self.parts, slopes.sum(1)).double().mT

        at, eye = turns.flatten(), torch.eye(size, dtype=torch.float64, device=turns.device)
        squares = torch.cat(typical)
        noise = max(float(squares.median()) if len(squares) else 0.0, 0.01)
        held = eye * (_STIFFNESS * noise / self.expected**2)
        right = rightness(turns)
        mean = torch.cat([share * eye[:3, :3] for share in right / right.sum()], 1)
        gauge = mean.mT @ mean * float(curve.diagonal().mean().clamp(min=1e-9)) * size
        answers = torch.linalg.inv(curve + held + gauge)
        step = -answers @ (sums.sum(0) + held @ at + gauge @ at)
        deeper = -(depth_slope + torch.tensordot(step.to(mixed), mixed, 1)) / depth_curve
        # Parts of the sphere are as good as independent, which neighbouring directions are not.
        variance = ((sums - sums.mean(0)) @ answers).square().sum(0) + _STIFFNESS * noise * answers.diagonal()
        return step.view_as(turns), deeper, variance.view_as(turns).sum(-1).sqrt(), agreed / compared


def _tangents(rays: Tensor) -> Tensor:
    """Two unit tangents ``(F, 2, V, 3)`` of rays ``(F, V, 3)``."""
    axis = torch.zeros_like(rays)
    axis.scatter_(-1, rays.abs().argmin(-1, keepdim=True), 1.0)
    first = F.normalize(torch.linalg.cross(axis, rays, dim=-1), dim=-1)
    return torch.stack((first, torch.linalg.cross(rays, first, dim=-1)), 1)
