# SPDX-License-Identifier: Apache-2.0
"""``Depth``: what a network says about one frame, on its own grid, as a panorama, in a camera, or as points."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras import Camera, CameraRig
from sphericalvision.cameras.checks import check_rigid
from sphericalvision.capture.preparation.preparation import Compensation, Correction
from sphericalvision.core import ArgumentError, check_type
from sphericalvision.geometry.lookup import weighted_sums
from sphericalvision.geometry.surfaces import distance_along
from sphericalvision.icosphere import Icosphere, locate
from sphericalvision.kernels import full_precision
from sphericalvision.models import DepthNetwork
from sphericalvision.shapes import check_shapes
from sphericalvision.sphere import Equirectangular
from sphericalvision.sweep import inverse_depth_from_index
from sphericalvision.sweep.hypotheses import INVERSE_DEPTH_OFFSET

if TYPE_CHECKING:
    import trimesh

    from sphericalvision.capture.points import SurfacePoints

STEPS = 15
"""From the nearest hypothesis to infinity, of which deviations are told."""
LEAST_DEVIATION, MOST_DEVIATION = 0.05, 2.0
"""Of the index: for a confidence of 1, and what is added for one of 0."""
SURE = 0.3
"""Confidence from which depth counts for the scale of pictures."""


class DepthImage(NamedTuple):
    """Depth in the pixels of a panorama or camera, with what is known about it.

    Attributes:
        depth: ``(*b, h, w)`` metres along the pixel's ray; NaN where the network's grid or the camera does not reach.
        confidence: ``(*b, h, w)`` 0 to 1.
        seen: ``(*b, h, w)`` True where two cameras saw that point; elsewhere the depth is a guess.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.scenes import make_scene, render_rig
        >>> from sphericalvision.capture import Predictor
        >>> rig = ring_rig(3, image_size=(24, 24))
        >>> answer = Predictor(rig, method="semi_global", level=3, min_depth=0.5)(render_rig(make_scene("room"), rig))
        >>> depth, confidence, seen = answer.panorama(8)
        >>> depth.shape
        torch.Size([8, 16])
    """

    depth: Float[Tensor, "*batch h w"]
    confidence: Float[Tensor, "*batch h w"]
    seen: Bool[Tensor, "*batch h w"]

    @property
    def measured(self) -> Float[Tensor, "*batch h w"]:
        """The depth where two cameras saw it, NaN elsewhere."""
        return self.depth.where(self.seen, math.nan)


@dataclass(frozen=True, eq=False)
class Depth:
    """Depth of a frame, or of a batch of frames, all around ``rig.center``.

    Attributes:
        index: ``(*b, *grid)`` hypothesis index on the network's grid; 0 is infinity, N - 1 is ``min_depth``.
        confidence: ``(*b, *grid)`` 0 to 1.
        seen: ``(*b, *grid)`` True where two cameras saw that point; elsewhere the index is a guess.
        network: the network; ``network.grid`` is the grid of the values.
        rig: the cameras.
        images: camera name -> ``(*b, 3, h, w)`` in [0, 1], for colours.
        corrections: of each frame a ``Correction`` or ``Compensation``, what was taken out of its images before depth
            was estimated; ``compensations`` has plain numbers.
        accumulated: ``(*grid)`` ``information`` of the average with the frames before; None for one frame alone.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.models import WinnerTakesAll
        >>> net, rig = WinnerTakesAll(3, 8, depth_coarsening=0), ring_rig(3, image_size=(16, 16))
        >>> depth = Depth(torch.full((642,), 3.5), torch.ones(642), torch.ones(642, dtype=torch.bool), net, rig, {})
        >>> panorama = depth.panorama(10)
        >>> panorama.depth.shape, panorama.depth.mean()  # index 3.5 of 7: twice the nearest depth
        (torch.Size([10, 20]), tensor(1.1000))
    """

    index: Float[Tensor, "*batch_and_grid"]
    confidence: Float[Tensor, "*batch_and_grid"]
    seen: Bool[Tensor, "*batch_and_grid"]
    network: DepthNetwork
    rig: CameraRig
    images: Mapping[str, Tensor] = field(repr=False)
    corrections: tuple[Correction | Compensation, ...] = field(default=(), repr=False)
    accumulated: Float[Tensor, "*batch_and_grid"] | None = field(default=None, repr=False)

    @property
    def information(self) -> Float[Tensor, "*batch_and_grid"]:
        """``(*b, *grid)`` in m²: 1 over the square of the expected deviation of the inverse depth.

        That is the more, the less the confidence: up to two steps of 16 hypotheses, which the confidence is trained on.
        """
        if self.accumulated is not None:
            return self.accumulated
        deviation = LEAST_DEVIATION + MOST_DEVIATION * (1 - self.confidence.float())
        return (STEPS * self.min_depth / deviation).square()

    @property
    def inverse_depth(self) -> Float[Tensor, "*batch_and_grid"]:
        """``(*b, *grid)`` in 1/m, at least that of index 0: depth is finite and positive."""
        return inverse_depth_from_index(self.index, self.network.num_hypotheses, self.min_depth)

    @property
    def depth(self) -> Float[Tensor, "*batch_and_grid"]:
        """``(*b, *grid)`` metres from the rig's centre along ``directions``."""
        return self.inverse_depth.reciprocal()

    @property
    def directions(self) -> Float[Tensor, "*grid 3"]:
        """``(*grid, 3)`` unit directions in the world, of the network's grid."""
        return self.network.grid.directions

    @property
    def min_depth(self) -> float:
        """Nearest hypothesis in metres: nothing is said to be nearer."""
        return self.network.min_depth

    @property
    def max_depth(self) -> float:
        """Metres; farther is not told from infinity: half a hypothesis away from it."""
        return float(self.network.depth(torch.tensor(0.5)))

    @property
    def compensations(self) -> tuple[Compensation, ...]:
        """Of each frame what was taken out of its images; none where that was not asked for."""
        return tuple(
            each if isinstance(each, Compensation) else each.compensation(self.rig)
            for each in self.corrections
        )

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """``*b``: no dimensions for one frame."""
        return tuple(self.index.shape[: self.index.ndim - len(self.network.grid.shape)])

    @property
    def share_seen(self) -> float:
        """Of one frame, the share of the sphere, by solid angle, that two cameras see at the depth estimated."""
        return float((_areas(self.network.grid) * self.seen).sum()) / (4 * math.pi)

    def __len__(self) -> int:
        if not self.batch_shape:
            raise TypeError("Depth of one frame has no length; a batch of images has")
        return self.batch_shape[0]

    def select(self, frame: int) -> Depth:
        """One frame of a batch."""
        if not self.batch_shape:
            raise ArgumentError("select: this is the depth of one frame, not of a batch")
        images = {name: image[frame] for name, image in self.images.items()}
        index, confidence, seen = self.index[frame], self.confidence[frame], self.seen[frame]
        corrections = self.corrections[frame : frame + 1 or None]
        return Depth(index, confidence, seen, self.network, self.rig, images, corrections)

    @full_precision
    def panorama(self, height: int) -> DepthImage:
        """Return depth as an equirectangular panorama ``(*b, height, 2 * height)`` around the rig's centre."""
        inverse_depth, confidence, seen = self._looked_up(height)
        shape = (*self.batch_shape, height, 2 * height)
        depth = inverse_depth.reciprocal().reshape(shape)
        return DepthImage(depth, confidence.reshape(shape), seen.reshape(shape))

    @full_precision
    @check_shapes
    def camera(
        self, camera: str | Camera, world_from_camera: Float[Tensor, "4 4"] | None = None
    ) -> DepthImage:
        """Return depth along the rays of a camera, as it would see the surface that was found.

        Args:
            camera: the name of one of the rig's cameras, which stands where it stands; or any camera.
            world_from_camera: pose ``(4, 4)`` of a camera that has no name, as seen from the rig's ``origin``; at the
                rig's centre, looking forward, when not given.

        Returns:
            Metres from the camera, ``(*b, h, w)``; NaN where it does not look or meets nothing.

        Raises:
            ArgumentError: the rig has no camera of this name, or that has a pose, too; a pose that is not rigid.
            ShapeError: a pose of another shape.

        Examples:
            >>> from sphericalvision.cameras import PinholeCamera, ring_rig
            >>> from sphericalvision.models import WinnerTakesAll
            >>> net, rig = WinnerTakesAll(3, 8, depth_coarsening=0), ring_rig(3, image_size=(16, 16))
            >>> half, ones = torch.full((642,), 3.5), torch.ones(642)
            >>> around = Depth(half, ones, ones > 0, net, rig, {})
            >>> view = PinholeCamera([2.0, 2.0], [1.0, 1.0], (3, 3))
            >>> around.camera(view).depth[1, 1]  # a ball of 1.1 m around the rig
            tensor(1.1000)
        """
        check_type("camera", camera, (str, Camera))
        if world_from_camera is not None:
            check_rigid("world_from_camera", world_from_camera.detach().double())
        if isinstance(camera, str):
            if world_from_camera is not None:
                raise ArgumentError(
                    f"world_from_camera: {camera!r} stands where it stands; for another pose give the camera itself, "
                    f"rig.cameras[{camera!r}]"
                )
            if camera not in self.rig.cameras:
                raise ArgumentError(
                    f"camera: expected a name among {', '.join(self.rig.names)}, got {camera!r}"
                )
            world_from_camera = self.rig.world_from_camera[self.rig.names.index(camera)]
            camera = self.rig.cameras[camera]
        pose = torch.eye(4) if world_from_camera is None else world_from_camera
        pose = pose.to(self.index.device, torch.float32)
        pixels = camera.pixel_grid(torch.float32).to(pose.device)
        directions, in_view = camera.to(self.index.device).unproject(pixels)
        rays = directions[in_view] @ pose[:3, :3].T
        center = self.rig.center.to(pose)
        start = center if world_from_camera is None else pose[:3, 3]
        frames = [self.select(i) for i in range(len(self))] if self.batch_shape else [self]
        views = []
        for frame in frames:
            distance = distance_along(rays, start - center, lambda d: frame.at(d)[0], self.min_depth)  # noqa: B023
            points = start - center + distance.nan_to_num(self.max_depth)[:, None] * rays
            _, confidence, seen = frame.at(torch.nn.functional.normalize(points, dim=-1))
            depth = directions.new_full(in_view.shape, math.nan)
            sure, seen_by_two = directions.new_zeros(in_view.shape), torch.zeros_like(in_view)
            depth[in_view], sure[in_view] = distance, confidence
            seen_by_two[in_view] = seen & distance.isfinite()
            views.append(DepthImage(depth, sure, seen_by_two))
        if not self.batch_shape:
            return views[0]
        return DepthImage(*(torch.stack(fields) for fields in zip(*views, strict=True)))

    @full_precision
    def points(
        self, min_confidence: float = 0.0, max_depth: float | None = None, voxel: float | None = None
    ) -> SurfacePoints:
        """Return what two cameras saw in one frame as coloured points with normals, one for each of the network's grid.

        Points that an estimate leaves hanging in the air between near and far are cut.

        Args:
            min_confidence: less confident points are left out.
            max_depth: metres; farther points are left out. What is not told from infinity always is.
            voxel: side of cubes, in metres, of which each keeps one point, the mean; all points when not given.

        Raises:
            ArgumentError: the depth is of a batch, or a number makes no sense.
        """
        from sphericalvision.capture.points import surface_points, voxel_means  # Matplotlib comes with it

        inverse_depth, confidence = self.inverse_depth.flatten().float(), self.confidence.flatten().float()
        mask = self._measured("points", min_confidence, max_depth, voxel)
        rig = self.rig.to(inverse_depth.device)
        cloud = surface_points(self.network.grid, inverse_depth, confidence, mask, rig, self.images)
        return cloud if voxel is None else voxel_means(cloud, voxel)

    @full_precision
    def mesh(self, min_confidence: float = 0.0, max_depth: float | None = None) -> trimesh.Trimesh:
        """Return what two cameras saw in one frame as a coloured mesh of the grid's triangles, cut where depth jumps.

        It faces the rig; triangles that would be steeper than 84° to the ray are left out.

        Args:
            min_confidence: triangles with less confident corners are left out.
            max_depth: metres; as in ``points``.

        Raises:
            ArgumentError: the depth is of a batch.

        Examples:
            >>> from sphericalvision.cameras import ring_rig
            >>> from sphericalvision.models import WinnerTakesAll
            >>> net, rig = WinnerTakesAll(3, 8, depth_coarsening=0), ring_rig(3, image_size=(16, 16))
            >>> images, ones = {name: torch.rand(3, 16, 16) for name in rig.names}, torch.ones(642)
            >>> mesh = Depth(3.5 * ones, ones, ones > 0, net, rig, images).mesh()
            >>> mesh.is_watertight, round(mesh.extents[0].item(), 1)  # a ball of 1.1 m
            (True, 2.2)
        """
        from sphericalvision.capture.points import grid_mesh  # Matplotlib comes with it

        mask, rig = self._measured("mesh", min_confidence, max_depth), self.rig.to(self.index.device)
        return grid_mesh(self.network.grid, self.inverse_depth.flatten().float(), mask, rig, self.images)

    def _measured(
        self, what: str, min_confidence: float, max_depth: float | None, voxel: float | None = None
    ) -> Tensor:
        """Which of the grid's points count ``(V,)``, of one frame."""
        if not 0 <= min_confidence <= 1:
            raise ArgumentError(f"min_confidence: expected 0 to 1, got {min_confidence!r}")
        for name, metres in (("max_depth", max_depth), ("voxel", voxel)):
            if metres is not None and not metres > 0:
                raise ArgumentError(f"{name}: expected metres above 0, got {metres!r}")
        if self.batch_shape:
            raise ArgumentError(f"{what}: this is the depth of a batch; take one frame with depth.select(i)")
        farthest = self.max_depth if max_depth is None else min(max_depth, self.max_depth)
        near_enough = self.inverse_depth.flatten().float() * farthest >= 1
        return self.seen.flatten() & (self.confidence.flatten().float() >= min_confidence) & near_enough

    @full_precision
    def at(
        self, directions: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"], Bool[Tensor, "*batch n"]]:
        """Return inverse depth in 1/m, confidence and seen ``(*b, n)`` in directions ``(n, 3)`` of the world.

        Inverse depth is NaN where the network's grid does not reach.
        """
        values, reached = self.network.index_at(self._together(), directions)  # all are located once
        return self._parts(values, reached)

    def _looked_up(self, height: int) -> tuple[Tensor, Tensor, Tensor]:
        """As ``at`` in the pixels of a panorama, whose places on an icosphere are kept from frame to frame."""
        grid, device = self.network.grid, self.index.device
        if not isinstance(grid, Icosphere) or type(self.network).index_at is not DepthNetwork.index_at:
            return self.at(panorama_rays(height, device))
        ids, weights = _located(grid.level, height, device)
        values = weighted_sums(self._together().unsqueeze(1), ids, weights).squeeze(1)
        return self._parts(values, torch.ones_like(ids[:, 0], dtype=torch.bool))

    def _together(self) -> Tensor:
        """Inverse depth, confidence and seen ``(3 * b, *grid)``."""
        grid = self.network.grid.shape
        number = self.index.numel() // math.prod(grid)
        fields = (self.inverse_depth, self.confidence, self.seen)
        return torch.cat([values.to(torch.float32).reshape(number, *grid) for values in fields])

    def _parts(self, values: Tensor, reached: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        inverse_depth, confidence, seen = values.reshape(3, *self.batch_shape, values.shape[-1])
        return positive(inverse_depth).where(reached, math.nan), confidence, (seen > 0.5) & reached


def positive(inverse_depth: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Return inverse depth in 1/m, at least that of index 0: what networks and interpolation say is off by rounding.

    Examples:
        >>> positive(torch.tensor([-1e-6, 0.5])).reciprocal()  # far away, not far behind
        tensor([8.3886e+06, 2.0000e+00])
    """
    return inverse_depth.clamp(min=INVERSE_DEPTH_OFFSET)


@lru_cache(maxsize=4)
@torch.inference_mode(False)
def _areas(grid: Icosphere | Equirectangular) -> Tensor:
    """Solid angles of a grid, which frames share."""
    return grid.solid_angles


@lru_cache(maxsize=4)
@torch.inference_mode(False)
def panorama_rays(height: int, device: torch.device) -> Tensor:
    """Directions ``(2 * height ** 2, 3)`` of a panorama's pixels, row by row."""
    return Equirectangular(height, 2 * height, device=device).directions.reshape(-1, 3)


@lru_cache(maxsize=4)
@torch.inference_mode(False)
def _located(level: int, height: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Vertices and weights ``(P, 3)`` of a panorama's pixels on an icosphere."""
    return locate(panorama_rays(height, device), level)


def near_end_of(depth: Depth) -> float:
    """Return the red end of pictures of a frame, in metres: about the nearest that was seen and that is sure.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.scenes import make_scene, render_rig
        >>> from sphericalvision.capture import Predictor
        >>> rig = ring_rig(4, image_size=(64, 64))
        >>> depth = Predictor(rig, method="semi_global", level=4, min_depth=0.1)(render_rig(make_scene("room", 1), rig))
        >>> near_end_of(depth)
        0.6
    """
    from sphericalvision.viz.color import near_end

    sure = depth.seen & (depth.confidence > SURE)
    return near_end(depth.depth.where(sure, math.nan), depth.min_depth)
